# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Reads a JSON object of a config with checks of type and range. Invalid values are collected as problems, and a harmless value is returned."""

from __future__ import annotations

from typing import Collection, Dict, Tuple

from .errors import Problems

# Far above any policy's sizes: a malicious config must not make the converter plan endlessly.
MAX_SIZE = 1 << 24
ANY_INT = -1 << 31
Fixed = Dict[str, Tuple[object, object]]  # key -> (default of the reference's class, the only value that the runtime supports)


class Section:
    """An object of a config. `defaults`: those of the reference's own class. `nullable`: keys for which the class treats null as the default."""

    def __init__(self, where: str, values: dict, defaults: Dict[str, object], problems: Problems, nullable=()):
        self.where, self.values, self.defaults, self.problems = where, values, dict(defaults), problems
        self.nullable = nullable

    def bad(self, key: str, expected: str, found=None, hint: str = "", unsupported: bool = False) -> None:
        add = self.problems.unsupported if unsupported else self.problems.add
        add("{}: {}".format(self.where, key), expected, repr(self.get(key)) if found is None else found, hint)

    def get(self, key: str):
        if key in self.values and (self.values[key] is not None or key not in self.nullable):
            return self.values[key]
        return self.defaults.get(key)

    def count(self, key: str, minimum: int = 1, maximum: int = MAX_SIZE) -> int:
        value = self.get(key)
        if isinstance(value, int) and not isinstance(value, bool) and minimum <= value <= maximum:
            return value
        self.bad(key, "a whole number from {} to {}".format(minimum, maximum))
        return max(minimum, 1)

    def number(self, key: str, above: float = 0.0) -> float:
        value = self.get(key)
        if isinstance(value, (int, float)) and not isinstance(value, bool) and above < value < 1e30:
            return float(value)
        self.bad(key, "a number above {}".format(above))
        return 1.0

    def fixed(self, key: str, value, hint: str = "") -> None:
        if self.values.get(key, value) != value:
            self.bad(key, repr(value), hint=hint, unsupported=True)

    def check_fixed(self, fixed: Fixed, hint: str = "") -> None:
        """Refuses values that the runtime does not support; an absent key has the default of the class."""
        for key, (default, value) in fixed.items():
            self.defaults[key] = default
            if self.get(key) != value:
                found = repr(self.values[key]) if key in self.values else "no such key, which means {!r}".format(default)
                self.bad(key, repr(value), found, hint, unsupported=True)

    def refuse_unknown(self, known: Collection[str]) -> None:
        for key in sorted(set(self.values) - set(known)):
            hint = "it may change numbers; a newer vla-convert may know it"
            self.bad(key, "a key that this converter knows", hint=hint, unsupported=True)

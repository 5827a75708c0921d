# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Errors of a conversion, with the same classes, exit codes and wording as the C++ runtime (src/base/result.h)."""

from __future__ import annotations

import enum
from typing import List, NamedTuple

from ..printable import printable

MAX_LINES = 50  # lines of a report; more problems mean that the checkpoint is the wrong one


class Code(enum.IntEnum):
    """Error classes that a conversion can end in; the value is the exit code of the process."""

    INTERNAL = 1
    USAGE = 2
    BAD_BUNDLE = 3  # the checkpoint is damaged, incomplete or contradicts itself
    UNSUPPORTED = 6  # the checkpoint may be valid, but needs something that the runtime does not support
    IO = 9


class Problem(NamedTuple):
    """An error: where it is, what was expected, what was found, and what to do next, if known."""

    where: str
    expected: str
    found: str
    hint: str = ""
    code: Code = Code.BAD_BUNDLE

    def message(self) -> str:
        """The error in one line, also if names and values from a file contain line ends."""
        text = "{}: expected {}, found {}".format(self.where, self.expected, self.found)
        return printable(text) + ("; " + printable(self.hint) if self.hint else "")


class ConvertError(Exception):
    """A refusal with one or several problems, all shown together."""

    def __init__(self, problems: List[Problem], subject: str = "") -> None:
        self.problems = list(problems)
        self.subject = subject
        super().__init__(self.message())

    @property
    def code(self) -> Code:
        return self.problems[0].code

    def message(self) -> str:
        if len(self.problems) == 1:
            return self.problems[0].message()
        lines = [printable("{}: {} problems".format(self.subject or "checkpoint", len(self.problems)))]
        lines += ["  " + problem.message() for problem in self.problems[:MAX_LINES]]
        if len(self.problems) > MAX_LINES:
            lines.append("  and {} more".format(len(self.problems) - MAX_LINES))
        return "\n".join(lines)


def refuse(where: str, expected: str, found: str, hint: str = "", code: Code = Code.BAD_BUNDLE) -> ConvertError:
    """One problem as an exception, to be raised by the caller."""
    return ConvertError([Problem(where, expected, found, hint, code)])


class Problems:
    """Collects problems, so that the user gets one complete report instead of one refusal per attempt."""

    def __init__(self, subject: str) -> None:
        self.subject = subject
        self.list: List[Problem] = []

    def add(self, where: str, expected: str, found: str, hint: str = "", code: Code = Code.BAD_BUNDLE) -> None:
        self.list.append(Problem(where, expected, str(found), hint, code))

    def unsupported(self, where: str, expected: str, found: str, hint: str = "") -> None:
        self.add(where, expected, found, hint, Code.UNSUPPORTED)

    def raise_any(self) -> None:
        if self.list:
            raise ConvertError(self.list, self.subject)

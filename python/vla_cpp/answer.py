# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Checks a server's answer against the request and the policy's description before a robot executes it.

Every client of this package returns only chunks that `checked` has returned.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Dict, Iterable, Optional, Tuple

import numpy as np

from .chunk import Chunk
from .errors import BadAction, Incompatible
from .printable import printable
from .spec import Spec

MAX_ANSWER = 16 << 20  # bytes of an answer, from any server
# A larger action gets a note: joints in degrees, positions in millimetres and encoder counts that a policy commands stay below.
FAR_ACTION = 1e6
MAX_ACTION = 2.0**32  # a larger action is refused: a 32-bit encoder counts no further


@dataclass(frozen=True)
class Asked:
    """The facts of a request that its answer must match.

    spec                   the robot's spec
    seed, capture_time_ns  as sent; None where they were not
    notes                  notes about the observation, to be added to the answer's
    """

    address: str
    spec: Spec
    seed: Optional[int]
    has_noise: bool
    capture_time_ns: Optional[int]
    notes: Tuple[str, ...] = ()

    def check(self, chunk: Chunk) -> Chunk:
        """Checks the chunk with `checked` and adds the observation's notes."""
        return checked(self.address, chunk, self._facts(chunk), self.notes)

    def _facts(self, chunk: Chunk) -> Tuple[Tuple[str, Any, Any], ...]:
        spec, rows = self.spec, chunk.normalized
        shape = spec.horizon, spec.d_action
        seed = None if self.has_noise else chunk.seed if self.seed is None else int(self.seed)
        return (
            ("shape", shape, chunk.actions.shape),
            ("column names", spec.action_names, chunk.names),
            ("seed", seed, chunk.seed),
            ("capture time", self.capture_time_ns or None, chunk.capture_time_ns),
            ("normalized rows", shape if spec.real_time_chunking else None, None if rows is None else rows.shape),
        )


def checked(address: str, chunk: Chunk, facts: Iterable[Tuple[str, Any, Any]], notes: Tuple[str, ...] = ()) -> Chunk:
    """Checks the chunk and returns it with `notes` and a note for each column whose actions are beyond FAR_ACTION.

    facts  (what, expected, found): pairs that must be equal

    Errors: Incompatible, BadAction.
    """
    for what, expected, found in facts:
        if expected != found:
            hint = "what listens there? a new client reads what its policy gives"
            raise Incompatible(f"{address}: {what} of the answer", _shown(expected), _shown(found), hint)
    for part in (chunk.actions, chunk.normalized):
        if part is not None and not np.isfinite(part).all():
            raise BadAction("answer", "finite actions", "one that is not")
        if part is not None and part.size and np.abs(part).max() > MAX_ACTION:
            raise BadAction("answer", f"actions within {MAX_ACTION:g}, as those of any robot are", f"{np.abs(part).max():g}")
    for what, value in (("rate_hz", chunk.rate_hz), ("queue_ms", chunk.queue_ms), *chunk.timing.items()):
        if not math.isfinite(value):
            raise Incompatible(f"{address}: {what} of the answer", "a finite number", str(value))
    notes = (*notes, *_far(chunk.actions, chunk.names))
    return replace(chunk, notes=(*chunk.notes, *notes)) if notes else chunk


def _far(actions: np.ndarray, names: Tuple[str, ...]) -> Tuple[str, ...]:
    """One note for each column with a value beyond FAR_ACTION."""
    largest = np.abs(actions).max(axis=0)
    return tuple(
        f'action "{name}": {value:.3g}, beyond {FAR_ACTION:g}, which no unit of a robot explains'
        for name, value in zip(names or map(str, range(len(largest))), largest)
        if value > FAR_ACTION
    )


def check_same_policy(address: str, known: Spec, found: Spec) -> None:
    """Refuses another policy after a reconnect. Device, kernels, precision and the bundle's file name may differ. Errors: Incompatible."""
    one, other = _interface(known), _interface(found)
    for name, value in one.items():
        if other[name] != value:
            hint = "make a new Client, and read its spec"
            raise Incompatible(f"{address}: {name}", _shown(value), _shown(other[name]), hint)


def _interface(spec: Spec) -> Dict[str, Any]:
    members = dict(vars(spec))
    for name in ("precision", "kernels", "device"):
        del members[name]
    members["bundle"] = spec.bundle.checksum
    members["robots"] = {tag: _interface(robot) for tag, robot in spec.robots.items()}
    return members


def _shown(value: Any) -> str:
    return "none" if value is None else printable(str(value)[:500])

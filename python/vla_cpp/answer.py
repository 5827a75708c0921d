# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What a server answers, compared with what was asked and with what it said of its policy before: a robot moves by it.

Every client of this package hands out what `checked` returns, and nothing else.
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

MAX_ANSWER = 16 << 20  # bytes, of any server
# Beyond any joint in degrees, position in millimetres or count of an encoder that a policy commands: a note.
FAR_ACTION = 1e6
MAX_ACTION = 2.0**32  # beyond what an encoder of 32 bits counts: refused


@dataclass(frozen=True)
class Asked:
    """What an answer must go with. spec: of the robot; seed, capture_time_ns: as sent, None where they were not; notes: of the
    observation, which the answer gets."""

    address: str
    spec: Spec
    seed: Optional[int]
    has_noise: bool
    capture_time_ns: Optional[int]
    notes: Tuple[str, ...] = ()

    def check(self, chunk: Chunk) -> Chunk:
        """As `checked`, with the notes of the observation."""
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
    """The chunk, with these notes and one for each column whose actions are far out.

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
    """One note for each column with a value that no robot is commanded."""
    largest = np.abs(actions).max(axis=0)
    return tuple(
        f'action "{name}": {value:.3g}, beyond {FAR_ACTION:g}, which no unit of a robot explains'
        for name, value in zip(names or map(str, range(len(largest))), largest)
        if value > FAR_ACTION
    )


def check_same_policy(address: str, known: Spec, found: Spec) -> None:
    """A server that comes back may compute on another device, and its file have another name. Errors: Incompatible."""
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

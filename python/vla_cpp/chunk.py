# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""A policy's answer to one observation."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Dict, Optional, Tuple

import numpy as np

from .printable import printable
from .spec import BundleInfo


@dataclass(frozen=True, eq=False)
class Chunk:
    """Actions for the next `horizon` control steps; `np.asarray(chunk)` is float32 (horizon, d_action) in world units.

    names            one per column
    normalized       the network's output before unnormalization, for a Leftover; None where the policy has no real-time chunking
    rate_hz          rows per second in the training data; 0 where the bundle does not say
    timing           milliseconds per stage, in the order in which they ran
    queue_ms         milliseconds that the request waited at a server; 0 in process
    seed             of the noise; None where the noise was given
    notes            warnings, e.g. that the instruction was truncated
    capture_time_ns  as given with the observation; None where it was not
    """

    actions: np.ndarray
    names: Tuple[str, ...]
    rate_hz: float
    bundle: BundleInfo
    timing: Dict[str, float] = field(default_factory=dict)
    queue_ms: float = 0.0
    seed: Optional[int] = None
    notes: Tuple[str, ...] = ()
    capture_time_ns: Optional[int] = None
    normalized: Optional[np.ndarray] = None

    def __array__(self, dtype=None, copy=None):
        """NumPy's array protocol, for NumPy 1 (without `copy`) and NumPy 2."""
        if dtype is not None and np.dtype(dtype) != self.actions.dtype:
            if copy is False:
                raise ValueError(f"a chunk is {self.actions.dtype}; as {np.dtype(dtype)} it must be copied")
            return self.actions.astype(dtype)
        return self.actions.copy() if copy else self.actions

    def __repr__(self) -> str:
        rate = f" at {self.rate_hz:g} Hz" if self.rate_hz else ""
        start = "" if self.seed is None else f", seed {self.seed}"
        lines = [f"{len(self.actions)} actions{rate} of {self.bundle.name}, in {sum(self.timing.values()):.1f} ms{start}"]
        for name, column in zip(self.names, self.actions.T):
            lines.append(f"  {name}  {column[0]:.4g} first, {column.min():.4g} to {column.max():.4g}")
        return "\n".join(map(printable, lines + ["  note  " + note for note in self.notes]))

    def __len__(self) -> int:
        return len(self.actions)

    def __getitem__(self, index):
        return self.actions[index]

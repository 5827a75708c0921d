# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""How overlapping chunks share a command.

A blend gives each source a weight for a step; the weights sum to 1, and the command is the weighted sum of the sources' rows. So the
change from one command to the next is bounded: if a share r of the weight changes hands between two steps, then

    |command' - command|  <=  (1 - r) * V + r * D

for each column, with V the largest change within a source from one row to the next, and D the largest difference between a row of
any source for the one step and a row of any source for the other. (The share 1 - r stays with its sources, which move by V at most;
the share r goes from some source to another, D apart at most.) What a blend does is to keep r small.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Optional, Sequence

import numpy as np

from ..errors import UsageError


@dataclass(frozen=True, eq=False)
class Source:
    """Rows that may be commanded. Row i is meant for step `step + i`.

    step     steps that the robot had consumed when the observation was taken
    tick     control period of the observation; None where the rows are no chunk but the last command, held
    rows     float32 (horizon, d_action)
    entered  first step that it serves
    fade     steps during which it shares the command with what was there before
    """

    step: int
    tick: Optional[int]
    rows: np.ndarray
    entered: int
    fade: int
    chunk: Any = None

    def rows_left(self, step: int) -> int:
        return self.step + len(self.rows) - step

    def row(self, step: int) -> np.ndarray:
        return self.rows[step - self.step]


class Blend:
    fade_steps = 0

    def weights(self, sources: Sequence[Source], step: int) -> np.ndarray:
        """One weight for each source (oldest observation first), in [0, 1], with the sum 1."""
        raise NotImplementedError


@dataclass(frozen=True)
class CrossFade(Blend):
    """A new chunk takes over in equal shares of 1 / (steps + 1) for each step; `CrossFade(0)` replaces at once.

    r is 1 / (k + 1) per step, where k is `steps`, or what the older chunk has left if that is less.
    """

    fade_steps: int

    def __post_init__(self) -> None:
        if self.fade_steps < 0:
            raise UsageError("fade_steps", "0 or more", str(self.fade_steps))

    def weights(self, sources: Sequence[Source], step: int) -> np.ndarray:
        weights = np.zeros(len(sources))
        weights[0] = 1.0
        for i, source in enumerate(sources[1:], 1):
            share = min(1.0, (step - source.entered + 1) / (source.fade + 1))
            weights *= 1.0 - share
            weights[i] = share
        return weights


@dataclass(frozen=True)
class Ensemble(Blend):
    """Temporal ensembling of ACT (Zhao et al. 2023, algorithm 2; imitate_episodes.py): all chunks that have a row for the step
    count, with weight exp(-decay * i), i = 0 for the oldest. 0.01 is what ACT published; there chunks come at every step.

    r is the share of the chunk that enters, or of one that has run out.
    """

    decay: float

    def __post_init__(self) -> None:
        if not 0 <= self.decay < np.inf:
            raise UsageError("decay", "a finite number, 0 or more", str(self.decay))

    def weights(self, sources: Sequence[Source], step: int) -> np.ndarray:
        # math.exp and a sum in order give the bits of the loop in C++; numpy's exp and sum differ in the last one.
        weights = np.array([math.exp(-self.decay * i) for i in range(len(sources))])
        return weights / np.cumsum(weights)[-1]

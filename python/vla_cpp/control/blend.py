# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Blends of overlapping chunks.

A blend gives each source a weight for a step; the weights sum to 1, and the command is the weighted sum of the sources' rows. This
bounds the change from one command to the next: if a share r of the weight moves from some sources to others between two steps, then

    |command' - command|  <=  (1 - r) * V + r * D

for each column. V is the largest change within a source from one row to the next. D is the largest difference between a row of any
source for the first step and a row of any source for the second. (The share 1 - r stays with its sources, whose rows change by at most V;
the share r moves to sources whose rows differ by at most D.) The purpose of a blend is to keep r small.
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

    step     number of rows commanded before the observation was taken
    tick     control period of the observation; None if the rows repeat the last command instead of coming from a chunk
    rows     float32 (horizon, d_action)
    entered  first step at which the source is used
    fade     number of steps over which the source takes over from the older sources
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
    """The weight of a new chunk grows by 1 / (fade_steps + 1) at each step; `CrossFade(0)` switches immediately.

    r is 1 / (k + 1) per step, where k is `fade_steps`, or the number of rows that the older chunk has left if that is less.
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
    """Temporal ensembling of ACT (Zhao et al. 2023, algorithm 2; imitate_episodes.py): every chunk with a row for the step has a weight
    proportional to exp(-decay * i), i = 0 for the oldest. ACT published 0.01, with a new chunk at every step.

    r is the weight of the chunk that enters, or of the one that ends.
    """

    decay: float

    def __post_init__(self) -> None:
        if not 0 <= self.decay < np.inf:
            raise UsageError("decay", "a finite number, 0 or more", str(self.decay))

    def weights(self, sources: Sequence[Source], step: int) -> np.ndarray:
        # math.exp and a sequential sum give the same bits as the loop in C++; numpy's exp and sum differ in the last bit.
        weights = np.array([math.exp(-self.decay * i) for i in range(len(sources))])
        return weights / np.cumsum(weights)[-1]

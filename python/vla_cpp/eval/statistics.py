# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The few statistics that success rates need, computed exactly and without further packages."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Iterable, Sequence, Tuple

Z95 = 1.959963984540054  # 97.5 % quantile of the normal distribution


def wilson(successes: int, episodes: int) -> Tuple[float, float]:
    """95 % score interval of a success rate; (0, 1) of no episode at all.

    Source: E. B. Wilson, Probable Inference, the Law of Succession, and Statistical Inference, JASA 22, 1927.
    """
    if episodes == 0:
        return 0.0, 1.0
    k, n, z = successes, episodes, Z95
    centre, spread = k + z * z / 2, z * math.sqrt(k * (n - k) / n + z * z / 4)
    # At the ends the exact value is 0 or 1, which rounding would miss by a hair.
    return max(0.0, (centre - spread) / (n + z * z)), min(1.0, (centre + spread) / (n + z * z))


@dataclass(frozen=True)
class Paired:
    """How often two policies solved the same episodes."""

    both: int
    only_a: int
    only_b: int
    neither: int

    @property
    def episodes(self) -> int:
        return self.both + self.only_a + self.only_b + self.neither

    @property
    def p_value(self) -> float:
        """Of McNemar's exact test, two-sided: how surprising so uneven a split of the discordant episodes would be if the policies
        were equally good. 1 where there are none."""
        n, k = self.only_a + self.only_b, min(self.only_a, self.only_b)
        tail = sum(math.comb(n, i) for i in range(k + 1))
        return min(1.0, 2.0 * tail / 2**n)


def paired(outcomes: Iterable[Tuple[bool, bool]]) -> Paired:
    """Counts (a solved, b solved) over episodes with the same seed."""
    rows = list(outcomes)
    return Paired(
        both=sum(a and b for a, b in rows),
        only_a=sum(a and not b for a, b in rows),
        only_b=sum(b and not a for a, b in rows),
        neither=sum(not a and not b for a, b in rows),
    )


def quantile(values: Sequence[float], share: float) -> float:
    """The value below which `share` of the values lie, between neighbours linearly; nan of nothing."""
    if not values:
        return math.nan
    ordered = sorted(values)
    at = share * (len(ordered) - 1)
    low = math.floor(at)
    high = min(low + 1, len(ordered) - 1)
    return ordered[low] + (at - low) * (ordered[high] - ordered[low])

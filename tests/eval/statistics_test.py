# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
import math

import pytest
from vla_cpp.eval.statistics import Paired, paired, quantile, wilson


@pytest.mark.parametrize(
    "k, n, low, high",
    [
        # Newcombe, Two-sided confidence intervals for the single proportion, Statistics in Medicine 17, 1998, table I.
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ],
)
def test_wilson_intervals_are_those_that_newcombe_published(k, n, low, high):
    assert wilson(k, n) == pytest.approx((low, high), abs=5e-5)


def test_an_interval_of_no_episodes_says_nothing():
    assert wilson(0, 0) == (0.0, 1.0)


def test_intervals_stay_within_0_and_1_and_hold_the_rate():
    for n in range(1, 60):
        for k in range(n + 1):
            low, high = wilson(k, n)
            assert 0 <= low <= k / n <= high <= 1


@pytest.mark.parametrize(
    "only_a, only_b, p",
    [(0, 0, 1.0), (1, 0, 1.0), (5, 5, 1.0), (0, 6, 2 * 0.5**6), (2, 8, 2 * (1 + 10 + 45) / 1024), (9, 1, 2 * 11 / 1024)],
)
def test_mcnemar_is_the_two_sided_binomial_test_of_the_discordant_episodes(only_a, only_b, p):
    assert Paired(30, only_a, only_b, 4).p_value == pytest.approx(p, rel=1e-12)


def test_pairs_are_counted_by_who_solved_them():
    table = paired([(True, True), (True, False), (True, False), (False, True), (False, False)])
    assert (table.both, table.only_a, table.only_b, table.neither, table.episodes) == (1, 2, 1, 1, 5)


def test_quantiles_lie_between_their_neighbours():
    assert quantile([3, 1, 2], 0.5) == 2
    assert quantile([0, 10], 0.95) == pytest.approx(9.5)
    assert quantile([7], 0.95) == 7
    assert math.isnan(quantile([], 0.5))

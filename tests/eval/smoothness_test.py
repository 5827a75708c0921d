# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from vla_cpp.eval.smoothness import mean_of, smoothness


def test_a_straight_line_has_a_rate_and_no_jerk():
    line = np.outer(np.arange(20), [0.5, -0.5])
    got = smoothness(line, [0, 8, 16], None)
    assert got["action_rate"] == pytest.approx(0.5) and got["jerk"] == pytest.approx(0, abs=1e-12)
    assert "gripper_flips" not in got and "border_jump" not in got  # there is no acceleration to compare with


def test_jerk_of_a_cubic_is_six_times_its_factor():
    cubic = np.arange(12.0)[:, None] ** 3
    assert smoothness(2 * cubic, [], None)["jerk"] == pytest.approx(12)


def test_a_jump_where_a_chunk_takes_over_is_told_apart_from_one_within_a_chunk():
    rng = np.random.default_rng(0)
    actions = rng.normal(0, 0.01, (32, 3))
    actions[16:] += 1.0
    assert smoothness(actions, [0, 16], None)["border_jump"] > 20
    assert smoothness(actions, [0, 8], None)["border_jump"] < 1


def test_the_gripper_counts_for_its_flips_alone_and_zero_is_no_sign():
    actions = np.zeros((6, 2))
    actions[:, 1] = [-1, -1, 0, 1, 1, -1]
    got = smoothness(actions, [0], 1)
    assert got["gripper_flips"] == 2 and got["action_rate"] == 0


@pytest.mark.parametrize("n", [0, 1, 2, 3])
def test_too_few_actions_have_fewer_measures_and_no_error(n):
    assert "jerk" not in smoothness(np.zeros((n, 2)), [0], 1)


def test_the_mean_is_over_the_episodes_that_have_a_measure():
    assert mean_of([{"jerk": 1.0}, {"jerk": 3.0, "action_rate": 2.0}, {}]) == {"jerk": 2.0, "action_rate": 2.0}

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What is commanded between two commands of a policy."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from simulation import N_EXAMPLE

from vla_cpp import BadAction, UsageError
from vla_cpp.control import Column, Interpolator, Limiter, Limits
from vla_cpp.control.interpolate import METHODS

many = settings(max_examples=N_EXAMPLE, deadline=None)
numbers = st.lists(st.floats(-2, 2), min_size=2, max_size=12)
methods = st.sampled_from(sorted(METHODS))


def filled(method, values, n, kind="position"):
    """n commands a period."""
    between = Interpolator([kind], method=method, rate_hz=20)
    between.start_at([values[0]])
    out = []
    for value in values[1:]:
        between.to([value])
        out += [float(between.at((i + 1) / n)[0]) for i in range(n)]
    return np.array(out)


@many
@given(numbers, methods, st.integers(1, 20))
def test_every_command_is_reached_at_the_end_of_its_period(values, method, n):
    assert filled(method, values, n)[n - 1 :: n] == pytest.approx(values[1:], abs=1e-5)


@many
@given(numbers, st.sampled_from((("linear", 0), ("cubic", 1), ("minimum_jerk", 2))))
def test_a_method_is_continuous_up_to_its_derivative(values, case):
    method, order = case
    between = Interpolator(["position"], method=method, rate_hz=20)
    between.start_at([values[0]])
    for value in values[1:]:
        before = between._motion(1.0)
        between._s = 1.0
        between.to([value])
        after = between._motion(0.0)
        assert [float(x[0]) for x in after[: order + 1]] == pytest.approx([float(x[0]) for x in before[: order + 1]], abs=1e-9)


def test_at_any_rate_a_steady_motion_stays_steady():
    for method in METHODS:
        out = filled(method, [0, *np.arange(1, 8) * 0.1], 10)
        assert np.diff(out[20:]) == pytest.approx(0.01, abs=1e-3)


def test_a_gripper_is_commanded_at_once():
    for method in METHODS:
        assert filled(method, [0, 1, 1, -1], 4, "gripper").tolist() == [1] * 8 + [-1] * 4


def test_the_end_of_a_motion_is_the_textbooks_minimum_jerk():
    s = np.arange(1, 11) / 10
    between = Interpolator(["position"], method="minimum_jerk", rate_hz=20)
    between.start_at([0.0])
    between._command = np.array([1.0])  # so that the motion ends at rest
    between.to([1.0])
    assert [float(between.at(x)[0]) for x in s] == pytest.approx(10 * s**3 - 15 * s**4 + 6 * s**5, abs=1e-6)


@many
@given(numbers, methods, st.integers(1, 20))
def test_velocities_are_held_and_differences_sum_to_what_was_commanded(values, method, n):
    assert (filled(method, values, n, "velocity") == np.repeat(np.float32(values[1:]), n)).all()
    parts = filled(method, values, n, "difference").reshape(-1, n)
    assert parts.sum(1) == pytest.approx(values[1:], abs=1e-5)
    assert parts == pytest.approx(np.repeat(np.array(values[1:])[:, None] / n, n, 1), abs=1e-6)


@many
@given(numbers, st.lists(st.floats(0.05, 1), min_size=12, max_size=12))
def test_a_period_that_is_cut_short_makes_no_jump(values, shares):
    between = Interpolator(["position"], method="cubic", rate_hz=20)
    between.start_at([values[0]])
    last = values[0]
    for value, share in zip(values[1:], shares):
        between.to([value])
        assert float(between.at(1e-6)[0]) == pytest.approx(last, abs=1e-4)
        last = float(between.at(share)[0])


def test_a_limiter_at_the_controllers_rate_keeps_what_is_interpolated_within_limits():
    limits = Limits((Column("x", "position", "", -1, 1, velocity=3, acceleration=40),), 1.0)
    limiter = Limiter(limits, 200)
    limiter.rest_at([0.0])
    rng = np.random.default_rng(3)
    out = np.array([float(limiter.step([x])[0][0]) for x in filled("cubic", [0, *rng.uniform(-1.5, 1.5, 30)], 10)])
    speed = np.diff(out) * 200
    assert np.abs(out).max() <= 1 + 1e-6 and np.abs(speed).max() <= 3.001 and np.abs(np.diff(speed) * 200).max() <= 40.1


def test_it_tells_what_it_adds_and_refuses_what_it_cannot_do():
    between = Interpolator(["position", "velocity"], method="linear", rate_hz=20)
    assert between.delay_s == 0.05
    with pytest.raises(UsageError, match="where the robot is"):
        between.to([0, 0])
    between.start_at([0.5, 3.0])
    between.to([0.5, 0.0])
    assert between.at(0.5) == pytest.approx([0.5, 0.0])
    for s in (0.5, 0.2, 1.1, math.nan):
        with pytest.raises(UsageError, match="above 0.5, 1 at most"):
            between.at(s)
    with pytest.raises(BadAction, match="2 finite numbers"):
        between.to([0.0])
    with pytest.raises(BadAction):
        between.to([0.0, math.inf])
    for changed in ({"method": "spline"}, {"rate_hz": 0}, {"kinds": ["place"]}, {"kinds": []}):
        arguments = {"kinds": ["position"], "method": "linear", "rate_hz": 20, **changed}
        with pytest.raises(UsageError, match=next(iter(changed))):
            Interpolator(arguments.pop("kinds"), **arguments)

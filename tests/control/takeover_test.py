# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""A person takes over and gives back: without a jump, within the limits, and with what the policy wanted beside it."""

import numpy as np
import pytest
from loop_test import Clock, Remote, loop_of

from vla_cpp import BadAction, UsageError
from vla_cpp.control import Column, Limits

LIMITS = Limits((Column("x", "position", "", -50, 50, velocity=20, acceleration=100),), 1.0)


@pytest.fixture
def clock():
    return Clock()


def run(loop, clock, n, state=0.0, human=None):
    actions = []
    for _ in range(n):
        actions.append(loop.step(dict(state=state), human=human))
        loop.pace()
    return actions


def test_a_person_commands_and_the_policy_is_asked_beside(clock):
    policy = Remote(clock)
    loop = loop_of(policy, clock)
    loop.begin(dict(state=5.0))
    assert [a.values[0] for a in run(loop, clock, 2, 5.0)] == [5, 6]
    loop.take_over("ana")
    asked = len(policy.seen)
    driven = run(loop, clock, 5, 9.0, human=[1.5])
    assert [a.values[0] for a in driven] == [1.5] * 5 and all(a.human and not a.held for a in driven)
    assert driven[0].policy[0] == 7.0 and driven[1].policy[0] == 8.0  # the next rows of the chunk before
    assert len(policy.seen) > asked  # new observations while the person drives
    assert loop.stats["human"] == 5 and loop.stats["actions"] == 2


def test_what_comes_after_giving_back_starts_from_what_is_seen_then(clock):
    policy = Remote(clock, latency=0.15)
    loop = loop_of(policy, clock)
    loop.begin(dict(state=0.0))
    run(loop, clock, 3)
    loop.take_over("ana")
    run(loop, clock, 3, 0.0, human=[40.0])
    loop.give_back("ana")
    after = run(loop, clock, 4, 40.0)
    assert [a.values[0] for a in after[:2]] == [40, 40] and after[0].held  # the person's last command, until a chunk of now is there
    assert after[2].values[0] >= 40 and not after[2].held  # a row of a chunk from the state that the person left


def test_nobody_jumps(clock):
    loop = loop_of(Remote(clock), clock, limits=LIMITS)
    loop.start_at([0.0])
    loop.begin(dict(state=0.0))
    commands = [a.values[0] for a in run(loop, clock, 5)]
    loop.take_over("ana")
    driven = run(loop, clock, 10, 0.0, human=[30.0])
    assert driven[0].clamped == (0,)
    commands += [a.values[0] for a in driven]
    loop.give_back("ana")
    commands += [a.values[0] for a in run(loop, clock, 20, 0.0)]
    velocity = np.diff(commands) * 10
    assert np.abs(velocity).max() <= 20.001 and np.abs(np.diff(velocity)).max() * 10 <= 100.01
    assert np.ptp(commands) > 10


def test_a_person_who_gives_no_command_holds(clock):
    loop = loop_of(Remote(clock), clock)
    loop.begin(dict(state=3.0))
    run(loop, clock, 2, 3.0)
    loop.take_over("ana")
    assert [(a.values[0], a.held, a.human) for a in run(loop, clock, 2, 3.0)] == [(4.0, True, False)] * 2


def test_one_person_drives(clock):
    loop = loop_of(Remote(clock), clock)
    with pytest.raises(UsageError, match="a person who drives"):
        loop.step(dict(state=0.0), human=[1.0])
    loop.take_over("ana")
    with pytest.raises(UsageError, match="expected nobody who drives, found ana"):
        loop.take_over("ben")
    with pytest.raises(UsageError, match="expected ben, who drives, found ana"):
        loop.give_back("ben")
    loop.give_back("ana")
    with pytest.raises(UsageError, match="found nobody"):
        loop.give_back("ana")


@pytest.mark.parametrize("command", [[np.nan], [np.inf], [1.0, 2.0], 1.0, []])
def test_a_command_that_is_none_is_refused_and_the_loop_goes_on(clock, command):
    loop = loop_of(Remote(clock), clock)
    loop.begin(dict(state=0.0))
    loop.take_over("ana")
    with pytest.raises(BadAction, match="human"):
        loop.step(dict(state=0.0), human=command)
    assert loop.step(dict(state=0.0), human=[2.0]).values[0] == 2.0


def test_reset_ends_it(clock):
    loop = loop_of(Remote(clock), clock)
    loop.take_over("ana")
    loop.reset()
    assert loop.driver is None
    loop.take_over("ben")

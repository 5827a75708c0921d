# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The driver: time, waiting, threads, errors. Clocks are made up; only where threads meet is real time waited for."""

import dataclasses
import threading
import time
import warnings

import numpy as np
import pytest

import vla_cpp
from vla_cpp import BundleInfo, Chunk, Spec, UsageError
from vla_cpp.control import ChunkLoop, Column, CrossFade, Limits, RealTimeChunking

HORIZON = 10
SPEC = Spec(
    views=(), min_views=0, states=(), action_names=("x",), action_units=("",), horizon=HORIZON, d_action=1, d_noise=1, noise_rows=HORIZON,
    noise="normal", rate_hz=10.0, bundle=BundleInfo("b", "a", "c", "s"), precision="", kernels="", device="",
)  # fmt: skip
ARGUMENTS = dict(rate_hz=10, replan_every=4, mode="async", blend="replace", on_late="hold", on_note="raise")


class Clock:
    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds


class Answer:
    def __init__(self, clock, due, outcome):
        self.clock, self.due, self.outcome = clock, due, outcome

    def done(self):
        return self.clock.now >= self.due - 1e-9

    def result(self):
        self.clock.now = max(self.clock.now, self.due)
        if isinstance(self.outcome, Exception):
            raise self.outcome
        return self.outcome


class Remote:
    """A policy like a client, whose answers take `latency` seconds of a made-up clock. Row i is state + i."""

    def __init__(self, clock, latency=0.0):
        self.spec, self.clock, self.latency = SPEC, clock, latency
        self.seen, self.errors = [], []

    def submit(self, *, state):
        self.seen.append(state)
        rows = state + np.arange(HORIZON, dtype=np.float32)[:, None]
        outcome = self.errors.pop(0) if self.errors else Chunk(rows, ("x",), 10.0, SPEC.bundle)
        return Answer(self.clock, self.clock.now + self.latency, outcome)


@pytest.fixture
def clock():
    return Clock()


def loop_of(policy, clock, **changed):
    return ChunkLoop(policy, clock=clock, sleep=clock.sleep, **{**ARGUMENTS, **changed})


def run(loop, n, state=0.0):
    actions = []
    for _ in range(n):
        actions.append(loop.step({"state": state}))
        loop.pace()
    return actions


def values(actions):
    return [None if a.values is None else float(a.values[0]) for a in actions]


def test_sync_waits_for_the_chunk_and_skips_no_row(clock):
    loop = loop_of(Remote(clock, latency=0.32), clock, mode="sync")
    actions = run(loop, 9)
    assert values(actions) == [0, 1, 2, 3, 0, 1, 2, 3, 0]
    assert not any(a.held for a in actions) and loop.stats["chunks"] == 3
    # Observations in the periods 0, 7 and 14; three periods later there is an action.
    assert [a.tick for a in actions] == [3, 4, 5, 6, 10, 11, 12, 13, 17]


def test_async_commands_the_old_rows_while_the_new_are_computed_and_skips_those_that_are_past(clock):
    loop = loop_of(Remote(clock, latency=0.15), clock)
    assert values(run(loop, 12)) == [None, None, 0, 1, 2, 3, 4, 5, 2, 3, 4, 5]
    assert loop.stats["delay"] == 2 and loop.stats["held"] == 2


def test_an_observation_is_asked_for_only_when_it_is_wanted(clock):
    policy, asked = Remote(clock), []
    loop = loop_of(policy, clock, mode="sync")
    for _ in range(9):
        loop.step(lambda: asked.append(1) or {"state": 0.0})
        loop.pace()
    assert len(asked) == len(policy.seen) == 3


def test_begin_waits_for_the_first_chunk_so_that_no_period_is_held(clock):
    loop = loop_of(Remote(clock, latency=3.0), clock)
    loop.begin({"state": 0.0})
    assert values(run(loop, 3)) == [0, 1, 2]
    assert loop.stats["delay"] is None and loop.stats["missed"] == 0


def test_pace_keeps_the_rate_whatever_the_caller_does_in_between(clock):
    loop = loop_of(Remote(clock), clock)
    times = []
    for used in (0.01, 0.09, 0.03, 0.0):
        loop.step({"state": 0.0})
        times.append(clock.now)
        clock.now += used
        loop.pace()
    assert times == pytest.approx([100.0, 100.1, 100.2, 100.3])


def test_periods_without_a_call_are_missed_and_chunks_grow_older_in_them(clock):
    loop = loop_of(Remote(clock), clock, mode="sync", max_age=0.5)
    run(loop, 2)
    clock.now += 1.0
    action = loop.step({"state": 50.0})
    assert action.tick == 12 and action.age == 0 and action.values[0] == 50
    assert loop.stats["missed"] == 10


def test_a_call_belongs_to_the_period_whose_begin_is_nearest(clock):
    loop = loop_of(Remote(clock), clock)
    ticks = []
    for now in (100.0, 100.14, 100.18, 100.36, 100.39):
        clock.now = now
        ticks.append(loop.step({"state": 0.0}).tick)
    assert ticks == [0, 1, 2, 4, 5] and loop.stats["missed"] == 1


def test_a_chunk_that_took_longer_than_max_age_is_never_commanded(clock):
    loop = loop_of(Remote(clock, latency=0.35), clock, max_age=0.3)
    assert all(a.held and a.values is None for a in run(loop, 20))
    assert loop.stats["stale"] == 4


def test_without_max_age_an_async_chunk_is_too_old_when_its_rows_would_have_passed(clock):
    assert loop_of(Remote(clock), clock).schedule._max_age == HORIZON
    assert loop_of(Remote(clock), clock, mode="sync").schedule._max_age is None
    assert loop_of(Remote(clock), clock, max_age=0.3).schedule._max_age == 3


@pytest.mark.parametrize(
    "error", [vla_cpp.Busy, vla_cpp.Superseded, vla_cpp.Late, vla_cpp.Timeout, vla_cpp.Disconnected]
)
@pytest.mark.parametrize("mode", ["sync", "async"])
def test_a_passing_error_is_counted_and_the_next_period_tries_again(clock, error, mode):
    policy = Remote(clock)
    policy.errors = [error("server", "", "it"), error("server", "", "it")]
    loop = loop_of(policy, clock, mode=mode)
    actions = run(loop, 6)
    assert loop.stats["failed"] == 2 and loop.stats[error.code] == 2 and loop.last_error is None
    assert [a.held for a in actions] == ([True, True, False] if mode == "sync" else [True, True, True]) + [False] * 3


@pytest.mark.parametrize(
    "error", [vla_cpp.BadObservation, vla_cpp.Incompatible, vla_cpp.BadAction, vla_cpp.InternalError]
)
@pytest.mark.parametrize("mode", ["sync", "async"])
def test_an_error_that_would_come_again_is_raised(clock, error, mode):
    policy = Remote(clock)
    policy.errors = [error("server", "", "it")]
    loop = loop_of(policy, clock, mode=mode)
    with pytest.raises(error):
        run(loop, 2)


def starved(clock, **changed):
    """A loop that has commanded its ten rows and gets no more."""
    policy = Remote(clock)
    loop = loop_of(policy, clock, mode="sync", **changed)
    run(loop, 1)
    policy.errors = [vla_cpp.Busy("server", "", "full")] * 30
    assert values(run(loop, 9)) == list(range(1, 10))
    return loop


def test_hold_repeats_the_last_command(clock):
    assert values(run(starved(clock), 3)) == [9, 9, 9]


def test_zero_commands_zeros(clock):
    assert values(run(starved(clock, on_late="zero"), 3)) == [0, 0, 0]


def test_stop_raises_and_goes_on_raising_until_it_is_reset(clock):
    loop = starved(clock, on_late="stop")
    for _ in range(2):
        with pytest.raises(vla_cpp.Late, match="stop the robot"):
            loop.step({"state": 0.0})
        clock.now += 0.1
    loop._policy.errors = []
    loop.reset()
    assert values(run(loop, 2)) == [0, 1]


def test_a_function_decides_what_a_held_period_commands(clock):
    loop = starved(clock, on_late=lambda last, tick: last / 3)
    assert values(run(loop, 2)) == [3, 1]


def test_a_function_that_answers_nonsense_is_refused(clock):
    with pytest.raises(vla_cpp.BadAction, match="on_late"):
        run(starved(clock, on_late=lambda last, tick: [np.nan]), 1)


class Noting(Remote):
    """One whose chunks come with two notes."""

    def submit(self, *, state):
        answer = super().submit(state=state)
        answer.outcome = dataclasses.replace(answer.outcome, notes=("the state is far out", "the text was cut"))
        return answer


@pytest.mark.parametrize("on_note, warned", [("ignore", []), ("warn", ["the state is far out", "the text was cut"])])
def test_notes_are_counted_and_warned_of_where_that_is_asked_for(clock, on_note, warned):
    loop = loop_of(Noting(clock), clock, mode="sync", on_note=on_note)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert values(run(loop, 2)) == [0, 1]
    assert [str(w.message) for w in caught] == warned and loop.stats["notes"] == 2
    loop.reset()
    assert loop.stats["notes"] == 0


def test_a_chunk_with_notes_is_never_commanded_where_they_are_to_be_raised(clock):
    loop = loop_of(Noting(clock), clock, mode="sync", on_note="raise")
    for _ in range(2):
        with pytest.raises(vla_cpp.Noted, match="the state is far out; the text was cut"):
            loop.step({"state": 0.0})
        clock.now += 0.1
    assert loop.stats["chunks"] == 0 and loop.stats["noted"] == 2 and loop.stats["notes"] == 4


def test_reset_begins_anew_and_what_was_under_way_is_not_used(clock):
    loop = loop_of(Remote(clock, latency=0.25), clock)
    loop.step({"state": 100.0})
    loop.reset()
    assert values(run(loop, 6, state=0.0)) == [None, None, None, 0, 1, 2]


class Slow:
    """A policy like the one in process: `act` blocks until it is let go."""

    def __init__(self):
        self.spec, self.go, self.frames = SPEC, threading.Event(), []

    def act(self, *, images, state):
        self.go.wait(5)
        self.frames.append(int(images["top"][0, 0, 0]))
        return Chunk(state + np.zeros((HORIZON, 1), np.float32), ("x",), 10.0, SPEC.bundle)


def test_a_policy_in_process_computes_in_a_thread_on_frames_that_stay_as_they_were_given(clock):
    policy, frame = Slow(), np.full((2, 2, 3), 7, np.uint8)
    with loop_of(policy, clock) as loop:
        assert loop.step({"images": {"top": frame}, "state": 1.0}).held
        frame[:] = 99
        policy.go.set()
        until = time.monotonic() + 5
        while not loop._handle.done() and time.monotonic() < until:
            time.sleep(0.001)
        clock.now += 0.1
        assert loop.step({"images": {"top": frame}, "state": 1.0}).values[0] == 1
        assert policy.frames == [7]


@pytest.mark.parametrize(
    "changed, where",
    [
        (dict(mode="both"), "mode"),
        (dict(rate_hz=0), "rate_hz"),
        (dict(rate_hz=20), "rate_hz"),
        (dict(replan_every=0), "replan_every"),
        (dict(replan_every=11), "replan_every"),
        (dict(blend="mean"), "blend"),
        (dict(blend="linear"), "fade_steps"),
        (dict(blend="linear", fade_steps=-1), "fade_steps"),
        (dict(blend="ensemble", decay=-1), "decay"),
        (dict(on_late="wait"), "on_late"),
        (dict(on_note="log"), "on_note"),
        (dict(max_age=-1), "max_age"),
        (dict(max_age=float("nan")), "max_age"),
        (dict(max_jump=0), "max_jump"),
    ],
)
def test_arguments_that_make_no_sense_are_refused_by_name(clock, changed, where):
    with pytest.raises(UsageError) as caught:
        loop_of(Remote(clock), clock, **changed)
    assert caught.value.where == where


@pytest.mark.parametrize("missing", ["mode", "blend", "on_late", "on_note"])
def test_what_changes_the_motion_has_no_default(clock, missing):
    arguments = {k: v for k, v in ARGUMENTS.items() if k != missing}
    with pytest.raises(TypeError, match=missing):
        ChunkLoop(Remote(clock), **arguments)


def test_rate_and_interval_are_what_the_bundle_says_and_told(clock, caplog):
    policy = Remote(clock)
    policy.spec = dataclasses.replace(SPEC, n_action_steps=3)
    loop = loop_of(policy, clock, rate_hz=None, replan_every=None, mode="sync")
    assert loop.rate_hz == 10.0
    assert [record.getMessage() for record in caplog.records] == ["rate_hz=10, as b says", "replan_every=3, as b says"]
    run(loop, 7)
    assert len(policy.seen) == 3
    caplog.clear()
    loop_of(policy, clock, replan_every=4)
    assert [record.getMessage() for record in caplog.records] == ["replan_every=4, where b says 3"]


@pytest.mark.parametrize("missing", ["rate_hz", "replan_every"])
def test_what_neither_the_caller_nor_the_bundle_says_is_asked_for(clock, missing):
    policy = Remote(clock)
    policy.spec = dataclasses.replace(SPEC, rate_hz=0.0)
    with pytest.raises(UsageError, match="since the bundle does not say"):
        loop_of(policy, clock, **{missing: None})


def test_another_rate_must_be_meant(clock):
    with pytest.raises(UsageError, match="moves at another speed"):
        loop_of(Remote(clock), clock, rate_hz=5)
    assert loop_of(Remote(clock), clock, rate_hz=5, allow_other_rate=True).rate_hz == 5


def test_a_blend_may_be_given_as_an_object(clock):
    assert loop_of(Remote(clock), clock, blend=CrossFade(3)).schedule._blend.fade_steps == 3


class Continuing(Remote):
    """One that goes on from rows, and tells which it got."""

    def __init__(self, clock, latency=0.0):
        super().__init__(clock, latency)
        self.spec, self.leftovers = dataclasses.replace(SPEC, real_time_chunking="guided"), []

    def submit(self, *, state, leftover=None):
        self.leftovers.append(leftover)
        answer = super().submit(state=state)
        answer.outcome = dataclasses.replace(answer.outcome, normalized=answer.outcome.actions * 10)
        return answer


def test_rtc_sends_the_rows_that_are_not_commanded_yet_and_how_many_will_be(clock):
    policy = Continuing(clock, latency=0.25)
    loop = loop_of(policy, clock, mode="rtc", rtc=RealTimeChunking(5, "linear", 10.0))
    loop.begin({"state": 0.0})
    run(loop, 11)
    first, second, third = policy.leftovers
    assert first is None  # there was no chunk yet
    assert second.rows.ravel().tolist() == [40, 50, 60, 70, 80] and second.delay == 0
    assert (second.schedule, second.max_guidance) == ("linear", 10.0)
    # The second chunk, for step 4, came three steps later.
    assert third.rows.ravel().tolist() == [40, 50, 60, 70, 80] and third.delay == 3 == loop.stats["delay"]


def test_rtc_is_refused_without_its_settings_and_without_a_policy_that_does_it(clock):
    settings = RealTimeChunking(5, "linear", 10.0)
    with pytest.raises(UsageError, match="rtc"):
        loop_of(Continuing(clock), clock, mode="rtc")
    with pytest.raises(UsageError, match="rtc"):
        loop_of(Continuing(clock), clock, mode="async", rtc=settings)
    with pytest.raises(UsageError, match="rtc.overlap"):
        loop_of(Continuing(clock), clock, mode="rtc", rtc=RealTimeChunking(11))
    with pytest.raises(vla_cpp.Unsupported, match="mode"):
        loop_of(Remote(clock), clock, mode="rtc", rtc=settings)


def test_a_loop_with_limits_starts_where_the_robot_is_and_keeps_them(clock):
    limits = Limits((Column("x", "position", "", -1, 3, velocity=5),), 0.9)  # rows of a chunk are 1 apart, at 10 Hz
    with loop_of(Remote(clock), clock, mode="sync", limits=limits) as loop:
        with pytest.raises(UsageError, match="start_at of the loop"):
            loop.step({"state": 0.0})
        loop.reset()
        with pytest.raises(UsageError, match="found 4, where the robot is"):
            loop.start_at([4.0])
        loop.start_at([0.0])
        values = []
        for _ in range(4):
            values.append(float(loop.step({"state": 0.0}).values[0]))
            loop.pace()
        assert values == [0.0, 0.5, 1.0, 1.5]
        assert loop.stats["limited"] == 3 and loop.stats["refused"] == 0
    with loop_of(Remote(clock), clock, mode="sync", limits=dataclasses.replace(limits, refuse_above=0.5)) as loop:
        loop.start_at([0.0])
        with pytest.raises(vla_cpp.BadAction, match="found 9 of 10, the first of them row 1"):
            loop.step({"state": 0.0})
        assert loop.stats["refused"] == 1
    with pytest.raises(UsageError, match="a loop with limits"):
        loop_of(Remote(clock), clock).start_at([0.0])

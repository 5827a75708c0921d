# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What holds for every life of a schedule, whatever comes when."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from simulation import N_EXAMPLE, admissible, hold_last, live, lives, make, row

from vla_cpp import BadAction, UsageError
from vla_cpp.control import ChunkSchedule, CrossFade, Ensemble

many = settings(max_examples=N_EXAMPLE)
ROUNDING = 1e-5  # of float32, for values up to 5


@many
@given(lives())
def test_ticks_rise_and_a_tick_has_one_action(life):
    schedule = make(life)
    ticks = [m.action.tick for m in live(life, schedule)]
    assert all(a < b for a, b in zip(ticks, ticks[1:]))
    for tick in (ticks[-1], ticks[-1] - 1):
        with pytest.raises(UsageError, match="later than"):
            schedule.next(tick)


@many
@given(lives())
def test_it_holds_if_and_only_if_no_chunk_has_a_row_that_is_young_enough(life):
    for moment in live(life):
        assert moment.action.held == (not admissible(life, moment))


@many
@given(lives())
def test_nothing_comes_from_a_chunk_older_than_allowed_nor_from_one_that_is_used_up(life):
    for moment in live(life):
        ticks = [tick for tick, weight in moment.action.sources if tick is not None]
        assert set(ticks) <= set(admissible(life, moment))
        if not moment.action.held:
            assert moment.action.age == moment.action.tick - min(ticks)
            assert life.max_age is None or moment.action.age <= life.max_age


@many
@given(lives(blend=st.just(CrossFade(0))))
def test_replacing_commands_the_newest_chunks_row_for_the_step_bit_for_bit(life):
    for moment in live(life):
        if not moment.action.held:
            step, rows, _ = moment.received[max(admissible(life, moment))]
            assert (moment.action.values == rows[moment.step - step]).all()


@many
@given(lives(blend=st.builds(Ensemble, st.floats(0, 3))))
def test_an_ensemble_is_acts_weighted_mean_of_all_chunks_oldest_first(life):
    for moment in live(life):
        if not moment.action.held:
            rows = np.array([row(moment, tick, moment.step) for tick in sorted(admissible(life, moment))])
            weights = np.exp(-life.blend.decay * np.arange(len(rows)))
            assert moment.action.values == pytest.approx((rows.T * weights).sum(1) / weights.sum(), abs=ROUNDING)


@many
@given(lives())
def test_weights_are_shares_of_one(life):
    for moment in live(life):
        weights = [weight for _, weight in moment.action.sources]
        assert all(0 < w <= 1 + 1e-12 for w in weights)
        assert moment.action.held or sum(weights) == pytest.approx(1)


def changes(life):
    """(moment before, moment, shares before, shares, row of a source by step): a source is a tick, or the command that was held."""
    moments = live(life)
    held = None
    for before, moment in zip(moments, moments[1:]):
        if moment.action.held or moment.last is None:
            continue
        old, new = (dict(m.action.sources) for m in (before, moment))
        # A fade from a held command begins at the last one, whatever made that: then no chunk is in both.
        if before.action.held or (None in new and not (set(old) & set(new)) - {None}):
            held, old = moment.last, {None: 1.0}
        yield (before, moment, *({t: (held if t is None else t, w) for t, w in x.items()} for x in (old, new)))


@many
@given(lives(age=st.none(), max_gap=1))
def test_a_command_changes_by_what_chunks_change_and_by_the_share_that_changes_hands(life):
    """The bound that python/vla_cpp/control/blend.py states and reasons."""
    for before, moment, old, new in changes(life):
        common = set(old) & set(new)
        r = 1 - sum(min(old[s][1], new[s][1]) for s in common)
        rows_old = {s: row(moment, source, before.step) for s, (source, _) in old.items()}
        rows_new = {s: row(moment, source, moment.step) for s, (source, _) in new.items()}
        within = np.max([abs(rows_new[s] - rows_old[s]) for s in common], axis=0) if common else 0
        apart = np.max([abs(b - a) for a in rows_old.values() for b in rows_new.values()], axis=0)
        change = abs(moment.action.values.astype(np.float64) - moment.last)
        assert (change <= (1 - r) * within + r * apart + ROUNDING).all()


@many
@given(lives(blend=st.builds(CrossFade, st.integers(0, 6)), max_gap=1))
def test_a_cross_fade_lets_no_more_change_hands_than_one_part_of_its_length(life):
    for _, moment, old, new in changes(life):
        r = 1 - sum(min(old[s][1], new[s][1]) for s in set(old) & set(new))
        running = [
            1 / (fade + 1)
            for tick, fade in moment.fades.items()
            if moment.received[tick][2] <= moment.step <= moment.received[tick][2] + fade
        ]
        assert r <= sum(running) + 1e-9


@many
@given(lives(jump=st.floats(0.01, 2)))
def test_no_command_differs_from_the_last_by_more_than_max_jump(life):
    for moment in live(life):
        if moment.last is not None and moment.action.values is not None:
            assert (abs(moment.action.values - moment.last) <= life.max_jump + ROUNDING).all()


@many
@given(lives(jump=st.floats(0.01, 20)))
def test_an_action_says_whether_it_was_cut(life):
    for _, moment, _, new in changes(life):
        uncut = sum(weight * row(moment, source, moment.step) for source, weight in new.values())
        beyond = (abs(uncut - moment.last) - life.max_jump).max()
        assert moment.action.limited == (beyond > 0) or abs(beyond) < ROUNDING


@many
@given(lives())
def test_the_same_events_give_the_same_actions(life):
    for a, b in zip(live(life), live(life)):
        assert (a.action.tick, a.action.held, a.action.sources) == (b.action.tick, b.action.held, b.action.sources)
        assert (a.action.values is None and b.action.values is None) or (a.action.values == b.action.values).all()


@many
@given(lives())
def test_counts_add_up(life):
    schedule = make(life)
    moments = live(life, schedule)
    held = sum(m.action.held for m in moments)
    assert (schedule.counts["held"], schedule.counts["actions"]) == (held, len(moments) - held)
    assert schedule.step == schedule.counts["actions"]
    assert schedule.counts["chunks"] == len(moments[-1].received)


# --- cases one can follow by hand ------------------------------------------------------------------------------------------------


def rows(first, horizon=10):
    """Row i is the step that it is meant for, where the observation was taken at step `first`."""
    return np.arange(first, first + horizon, dtype=np.float32)[:, None]


def schedule_of(**changed):
    arguments = dict(horizon=10, d_action=1, replan_every=4, blend=CrossFade(0), on_late=hold_last)
    return ChunkSchedule(**{**arguments, **changed})


def test_rows_that_are_past_when_a_chunk_comes_are_skipped_and_the_delay_counts_them():
    s = schedule_of()
    s.observe(0)
    s.receive(rows(0), 0)
    assert [s.next(t).values[0] for t in range(4)] == [0, 1, 2, 3]
    assert s.wants(4)
    s.observe(4)
    assert [s.next(t).values[0] for t in (4, 5, 6)] == [4, 5, 6]
    s.receive(100 + rows(4), 7)
    assert s.next(7).values[0] == 107
    assert s.delay == 3


def test_waiting_for_the_first_chunk_is_no_delay_and_skips_no_row():
    s = schedule_of()
    s.observe(0)
    assert all(s.next(t).held and s.counts["actions"] == 0 for t in range(5))
    s.receive(rows(0), 5)
    action = s.next(5)
    assert (action.values[0], action.age, s.delay) == (0, 5, None)


def test_a_robot_that_held_still_goes_on_with_the_row_after_the_last_that_it_was_given():
    s = schedule_of(replan_every=10)
    s.observe(0)
    s.receive(rows(0), 0)
    for t in range(10):
        s.next(t)
    s.observe(10)
    held = [s.next(t) for t in range(10, 14)]
    assert all(a.held and a.values[0] == 9 for a in held)
    s.receive(rows(10), 14)
    assert s.next(14).values[0] == 10


def test_a_chunk_that_comes_when_its_rows_are_used_up_or_too_old_is_dropped_and_counted():
    s = schedule_of(max_age=3)
    s.observe(0)
    assert not s.receive(rows(0), 4)
    assert s.counts["stale"] == 1 and s.wants(4) and s.next(4).held


def between_chunks(tick, **options):
    """A schedule at a tick where ones follow the zeros of the chunk before."""
    s = schedule_of(**options)
    s.observe(0)
    s.receive(np.zeros((10, 1)), 0)
    for t in range(tick):
        s.next(t)
    s.observe(tick)
    s.receive(np.ones((10, 1)), tick)
    return s


def test_a_linear_fade_takes_equal_steps_from_the_old_chunk_to_the_new():
    s = between_chunks(4, blend=CrossFade(3))
    assert [s.next(t).values[0] for t in range(4, 9)] == [0.25, 0.5, 0.75, 1, 1]


def test_a_fade_is_no_longer_than_what_is_left_of_the_old_chunk():
    s = between_chunks(8, blend=CrossFade(6), replan_every=8)
    assert [s.next(t).values[0] for t in range(8, 11)] == pytest.approx([1 / 3, 2 / 3, 1])


def test_a_fade_is_done_when_the_old_chunk_becomes_too_old():
    s = between_chunks(4, blend=CrossFade(6), max_age=6)
    assert [s.next(t).values[0] for t in range(4, 8)] == pytest.approx([0.25, 0.5, 0.75, 1])


def test_an_ensemble_trusts_the_oldest_most():
    s = between_chunks(4, blend=Ensemble(1.0))
    assert s.next(4).values[0] == pytest.approx(np.exp(-1) / (1 + np.exp(-1)))


def test_after_a_hold_a_linear_fade_starts_from_the_command_that_was_held():
    s = schedule_of(blend=CrossFade(1), replan_every=10, on_late=lambda last, tick: np.array([5.0]))
    s.observe(0)
    s.receive(np.zeros((10, 1)), 0)
    for t in range(10):
        s.next(t)
    s.observe(10)
    assert s.next(10).values[0] == 5
    s.receive(np.ones((10, 1)), 11)
    fading = s.next(11)
    assert fading.values[0] == 3 and fading.sources == ((None, 0.5), (10, 0.5)) and fading.age == 1
    assert s.next(12).values[0] == 1


def test_a_loop_that_was_stopped_stays_stopped_until_it_is_reset():
    def stop(last, tick):
        raise RuntimeError("stop")

    s = schedule_of(on_late=stop, replan_every=10)
    s.observe(0)
    s.receive(rows(0), 0)
    for t in range(10):
        s.next(t)
    s.observe(10)
    with pytest.raises(RuntimeError):
        s.next(10)
    s.receive(rows(10), 11)
    with pytest.raises(RuntimeError):
        s.next(11)
    s.reset()
    s.observe(0)
    s.receive(rows(0), 0)
    assert s.next(0).values[0] == 0


@pytest.mark.parametrize("chunk", [np.zeros((9, 1)), np.zeros((10, 2)), np.full((10, 1), np.nan), np.zeros(10)])
def test_a_chunk_of_another_shape_or_not_finite_is_refused_and_not_used(chunk):
    s = schedule_of()
    s.observe(0)
    with pytest.raises(BadAction):
        s.receive(chunk, 0)
    assert s.next(0).held


@pytest.mark.parametrize(
    "arguments",
    [
        dict(replan_every=0),
        dict(replan_every=11),
        dict(max_age=-1),
        dict(max_jump=0.0),
        dict(max_jump=[1.0, 1.0]),
        dict(max_jump=float("nan")),
    ],
)
def test_arguments_that_make_no_sense_are_refused(arguments):
    with pytest.raises(UsageError):
        schedule_of(**arguments)


def test_a_second_observation_and_a_chunk_that_nobody_asked_for_are_refused():
    s = schedule_of()
    with pytest.raises(UsageError):
        s.receive(rows(0), 0)
    s.observe(0)
    with pytest.raises(UsageError):
        s.observe(0)


def test_what_a_caller_does_to_an_action_does_not_reach_the_next():
    s = schedule_of(replan_every=10, max_jump=0.5)
    s.observe(0)
    s.receive(np.zeros((10, 1)), 0)
    s.next(0).values[:] = 100
    assert s.next(1).values[0] == 0

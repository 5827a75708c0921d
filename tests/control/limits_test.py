# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""No command breaks a limit, and none that keeps all of them is changed, whatever is wanted."""

import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from simulation import N_EXAMPLE

from vla_cpp import BadAction, UsageError
from vla_cpp.control import ChunkSchedule, Column, CrossFade, Limiter, Limits
from vla_cpp.control.blend import Ensemble
from vla_cpp.control.limits import KINDS
from vla_cpp.control.schedule import late_rule
from vla_cpp.spec import BundleInfo, Spec

many = settings(max_examples=-(-N_EXAMPLE // 3), deadline=None)  # an example takes a third of a second
STEPS = 40


def maybe(low, high):
    return st.one_of(st.none(), st.floats(math.log(low), math.log(high)).map(math.exp))


@st.composite
def columns(draw, name):
    ranged = draw(st.booleans())
    low, high = (-draw(st.floats(0.05, 3)), draw(st.floats(0.05, 3))) if ranged else (None, None)
    kind = draw(st.sampled_from(KINDS))
    most = () if kind == "gripper" else (draw(maybe(0.1, 10)), draw(maybe(0.3, 60)), draw(maybe(2, 1000)))
    return Column(name, kind, "", low, high, *most)


@st.composite
def drives(draw):
    """Limits of three columns, a rate, and wanted commands that jump, wander or stand still."""
    limits = Limits(tuple(draw(columns(f"c{i}")) for i in range(3)), 1.0)
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    wanted = rng.uniform(-4, 4, (STEPS, 3))
    still = rng.random((STEPS, 3)) < draw(st.sampled_from((0.0, 0.3, 0.9)))
    for i in range(1, STEPS):
        wanted[i] = np.where(still[i], wanted[i - 1], wanted[i])
    wander = draw(st.sampled_from((None, 0.02, 0.3)))
    if wander:
        wanted = np.cumsum(wander * rng.standard_normal((STEPS, 3)), 0)
    return limits, draw(st.sampled_from((5.0, 20.0, 50.0))), wanted


def driven(limits, rate_hz, wanted):
    """What a Limiter makes of wanted commands, from rest at zero; and the columns that it says it cut."""
    limiter = Limiter(limits, rate_hz)
    limiter.rest_at(np.zeros(len(limits.columns)))
    results = [limiter.step(row) for row in wanted]
    return np.array([out for out, _ in results]), np.array([cut for _, cut in results])


def excess(column, rate_hz, commands):
    """The largest excess of any limit of a column, as a share of it; commands begin after rest at zero. Written from the definitions."""
    values = np.concatenate([np.zeros(3), commands.astype(np.float64)])
    if column.kind == "position":
        velocity = np.diff(values) * rate_hz
    else:  # of a gripper only the range is limited
        velocity = values[1:] * (rate_hz if column.kind == "difference" else 1)
    acceleration = np.diff(velocity) * rate_hz
    jerk = np.diff(acceleration) * rate_hz
    rounding = 2.0**-23 * np.abs(values).max()
    worst = 0.0
    for most, found, scale in (
        (column.velocity, velocity, rate_hz),
        (column.acceleration, acceleration, rate_hz**2),
        (column.jerk, jerk, rate_hz**3),
    ):
        if most is not None:
            worst = max(worst, (np.abs(found).max() - 8 * rounding * scale) / most - 1)
    if column.low is not None:
        worst = max(worst, (column.low - commands.min() - rounding) / abs(column.low), (commands.max() - column.high - rounding) / abs(column.high))
    return worst


@many
@given(drives())
def test_no_command_breaks_a_limit(drive):
    limits, rate_hz, wanted = drive
    commands, _ = driven(limits, rate_hz, wanted)
    for i, column in enumerate(limits.columns):
        assert excess(column, rate_hz, commands[:, i]) < 1e-5


@many
@given(drives())
def test_what_keeps_the_limits_is_not_changed(drive):
    limits, rate_hz, wanted = drive
    commands, cut = driven(limits, rate_hz, wanted)
    assert (commands[~cut] == wanted.astype(np.float32)[~cut]).all()
    assert (commands[cut] != wanted.astype(np.float32)[cut]).all()
    calm = 1e-3 * wanted / np.abs(wanted).max() / rate_hz**3  # under every limit that is drawn
    commands, cut = driven(limits, rate_hz, calm)
    assert not cut.any() and (commands == calm.astype(np.float32)).all()


@many
@given(drives())
def test_a_column_is_cut_for_its_own_limits_alone(drive):
    limits, rate_hz, wanted = drive
    together, _ = driven(limits, rate_hz, wanted)
    for i, column in enumerate(limits.columns):
        alone, _ = driven(Limits((column,), 1.0), rate_hz, wanted[:, i : i + 1])
        assert alone[:, 0] == pytest.approx(together[:, i], abs=1e-12)


def test_a_jump_becomes_the_fastest_permitted_motion_and_ends_there():
    limits = Limits((Column("x", "position", "", -1, 1, velocity=1, acceleration=5),), 1.0)
    commands, cut = driven(limits, 10.0, [[0.5]] * 16)
    assert commands[:6, 0] == pytest.approx([0.05, 0.15, 0.25, 0.35, 0.45, 0.5], abs=1e-3)  # 5 / 10^2 a step faster, 0.1 at most
    assert commands[-1, 0] == np.float32(0.5) and not cut[-1].any()


def test_a_motion_towards_a_stop_brakes_before_it():
    limits = Limits((Column("x", "position", "", -1, 1, velocity=2, acceleration=4),), 1.0)
    commands, _ = driven(limits, 20.0, [[5.0]] * 40)
    speed = np.diff(commands[:, 0]) * 20
    assert commands.max() <= 1 and commands[-1, 0] == pytest.approx(1, abs=1e-3)
    assert speed.max() == pytest.approx(2, abs=0.25) and np.abs(np.diff(speed) * 20).max() < 4.001


def test_a_gripper_may_jump_within_its_range():
    limits = Limits((Column("grip", "gripper", "", 0.2, 0.8),), 0.5)
    limiter = Limiter(limits, 10)
    limiter.rest_at([0.0])  # outside of what may be commanded: a gripper that is forced open
    wanted = [0.2, 0.8, 0.25, 1.0, -1.0]
    found = [limiter.step([value]) for value in wanted]
    assert [float(out[0]) for out, _ in found] == pytest.approx([0.2, 0.8, 0.25, 0.8, 0.2])
    assert [bool(cut[0]) for _, cut in found] == [False, False, False, True, True]
    assert limiter.still() == pytest.approx([0.2])
    assert limiter.breaks(np.array([[0.2], [0.8], [0.9]])).tolist() == [False, False, True]


def test_a_limiter_wants_to_know_where_the_robot_is():
    limits = Limits((Column("x", "position", "", -1, 1),), 1.0)
    limiter = Limiter(limits, 20)
    with pytest.raises(UsageError, match="where the robot is"):
        limiter.step([0.0])
    with pytest.raises(UsageError, match=r"limits\.x: expected -1 to 1, found 1.5, where the robot is"):
        limiter.rest_at([1.5])
    limiter.rest_at([1.0])
    with pytest.raises(BadAction, match="1 finite numbers"):
        limiter.step([math.nan])
    assert limiter.step([1.0])[0] == [1.0]
    limiter.reset()
    with pytest.raises(UsageError):
        limiter.step([0.0])


# --- a schedule with limits ------------------------------------------------------------------------------------------------------


def schedule_of(limits, on_late=lambda last, tick: last):
    limiter = Limiter(limits, 10)
    schedule = ChunkSchedule(horizon=4, d_action=1, replan_every=4, blend=CrossFade(0), on_late=on_late, limiter=limiter)
    limiter.rest_at([0.0])
    return schedule


def test_a_chunk_with_too_many_broken_rows_is_refused_and_the_robot_comes_to_rest():
    schedule = schedule_of(Limits((Column("x", "position", "", -1, 1, velocity=1, acceleration=5),), 0.5))
    schedule.observe(0)
    schedule.receive(np.array([[0.05], [0.15], [0.25], [0.35]]), 0)
    moving = [schedule.next(tick).values[0] for tick in range(4)]
    assert moving == pytest.approx([0.05, 0.15, 0.25, 0.35])
    schedule.observe(4)
    with pytest.raises(BadAction, match=r"at most a share of 0.5 of its rows outside of the limits, found 3 of 4, the first of them row 1"):
        schedule.receive(np.array([[0.3], [0.9], [0.3], [0.9]]), 4)
    assert schedule.counts["refused"] == 1
    stop = [schedule.next(tick) for tick in range(4, 7)]
    assert [action.held for action in stop] == [True] * 3
    assert [action.values[0] for action in stop] == pytest.approx([0.4, 0.4, 0.4], abs=0.021)  # half as fast, then rest
    assert stop[0].clamped == (0,) and stop[0].limited


def test_an_action_says_which_columns_were_cut():
    schedule = schedule_of(Limits((Column("x", "position", "", -1, 1, velocity=1),), 1.0))
    schedule.observe(0)
    schedule.receive(np.array([[0.05], [0.9], [0.9], [0.25]]), 0)
    actions = [schedule.next(tick) for tick in range(4)]
    assert [action.clamped for action in actions] == [(), (0,), (0,), ()]
    assert [float(action.values[0]) for action in actions] == pytest.approx([0.05, 0.15, 0.25, 0.25])
    assert schedule.counts["limited"] == 2


@pytest.mark.parametrize("blend", (CrossFade(3), Ensemble(0.1)))
def test_a_gripper_takes_the_newest_chunks_value(blend):
    limiter = Limiter(Limits((Column("x", "position"), Column("grip", "gripper")), 1.0), 10)
    schedule = ChunkSchedule(horizon=8, d_action=2, replan_every=1, blend=blend, on_late=None, limiter=limiter)
    limiter.rest_at([0, -1])
    found = []
    for tick, value in enumerate((-1.0, 1.0, 1.0)):
        schedule.observe(tick)
        schedule.receive(np.full((8, 2), value), tick)
        found.append(schedule.next(tick).values)
    assert [row[1] for row in found] == [-1, 1, 1]
    assert -1 < found[1][0] < found[2][0] < 1


def test_a_robot_that_stands_still_keeps_what_its_gripper_holds():
    limiter = Limiter(Limits((Column("dx", "difference"), Column("grip", "gripper")), 1.0), 10)
    schedule = ChunkSchedule(horizon=1, d_action=2, replan_every=1, blend=CrossFade(0), on_late=late_rule("zero", 2, limiter), limiter=limiter)
    limiter.rest_at([0, 0.3])
    assert schedule.next(0).values.tolist() == [0, np.float32(0.3)]
    schedule.observe(1)
    schedule.receive(np.array([[0.5, 1.0]]), 1)
    assert schedule.next(1).values.tolist() == [0.5, 1]
    late = schedule.next(2)
    assert late.held and late.values.tolist() == [0, 1]


def test_limits_and_the_largest_jump_exclude_each_other():
    with pytest.raises(UsageError, match="max_jump"):
        limiter = Limiter(Limits((Column("x", "position"),), 1.0), 10)
        ChunkSchedule(horizon=1, d_action=1, replan_every=1, blend=CrossFade(0), on_late=None, max_jump=1, limiter=limiter)


# --- files -----------------------------------------------------------------------------------------------------------------------

SPEC = Spec((), 0, (), ("pan", "grip"), ("radians", ""), 4, 2, 2, 4, "normal", 20.0, BundleInfo("b.gguf", "act", "", ""), "", "", "")
GOOD = {
    "format": "vla-limits 1",
    "columns": {
        "grip": {"kind": "position", "unit": "", "range": [0, 1]},
        "pan": {"kind": "position", "unit": "radians", "range": [-1.5, None], "velocity": 2, "acceleration": 10, "jerk": 200},
    },
    "refuse_above": 0.25,
}


def changed(**columns):
    return {**GOOD, "columns": {**GOOD["columns"], **columns}}


def test_a_file_is_read_written_and_put_into_the_policys_order(tmp_path):
    (tmp_path / "a.json").write_text(json.dumps(GOOD))
    limits = Limits.read(tmp_path / "a.json").of(SPEC)
    assert limits.columns[0] == Column("pan", "position", "radians", -1.5, None, 2, 10, 200)
    assert [c.name for c in limits.columns] == ["pan", "grip"] and limits.refuse_above == 0.25
    limits.write(tmp_path / "b.json")
    assert Limits.read(tmp_path / "b.json") == limits


@pytest.mark.parametrize(
    "document, message",
    [
        ([], "format"),
        ({**GOOD, "format": "vla-limits 2"}, 'of format "vla-limits 1"'),
        ({**GOOD, "more": 1}, "format"),
        ({**GOOD, "columns": {}}, "each action's name"),
        ({**GOOD, "refuse_above": 1.5}, "a share of rows"),
        ({**GOOD, "refuse_above": True}, "a number"),
        (changed(pan={"kind": "position"}), "kind and unit"),
        (changed(pan={"kind": "place", "unit": ""}), "one of position, velocity, difference"),
        (changed(pan={"kind": "position", "unit": 1}), "a text"),
        (changed(pan={"kind": "position", "unit": "", "speed": 1}), "of acceleration, jerk, range, velocity"),
        (changed(pan={"kind": "position", "unit": "", "range": [1, -1]}), "the least below the largest"),
        (changed(pan={"kind": "position", "unit": "", "range": [1]}), r"\[least, largest\]"),
        (changed(pan={"kind": "velocity", "unit": "", "range": [0.5, 1]}), "zero in the range"),
        (changed(pan={"kind": "gripper", "unit": "", "velocity": 1}), "none of a gripper, which may jump; one that is slowed is a position"),
        (changed(pan={"kind": "position", "unit": "", "velocity": 0}), "above 0"),
        (changed(pan={"kind": "position", "unit": "", "jerk": -1}), "above 0"),
        (changed(pan={"kind": "position", "unit": "", "velocity": 1e300}), "a number up to"),
    ],
)
def test_what_the_document_does_not_say_is_refused(document, message):
    with pytest.raises(UsageError, match=message):
        Limits.parse(document)


@pytest.mark.parametrize("text", ["", "{", '{"format": NaN}', '{"format": 1, "format": 2}', "[" * 100000])
def test_a_damaged_file_is_refused(tmp_path, text):
    (tmp_path / "x.json").write_text(text)
    with pytest.raises(UsageError, match="x.json"):
        Limits.read(tmp_path / "x.json")


@pytest.mark.parametrize("path", ["/dev/zero", "/", "nothing.json"])
def test_what_is_no_file_is_refused_without_being_read(path):
    with pytest.raises(UsageError, match="found no regular file"):
        Limits.read(path)


def test_limits_of_another_robot_are_refused():
    with pytest.raises(UsageError, match="without grip"):
        Limits.parse({**GOOD, "columns": {"pan": GOOD["columns"]["pan"]}}).of(SPEC)
    with pytest.raises(UsageError, match="with tilt"):
        Limits.parse(changed(tilt={"kind": "position", "unit": ""})).of(SPEC)
    with pytest.raises(UsageError, match=r'limits\.pan\.unit: expected "radians", as b.gguf says, found "degrees"'):
        Limits.parse(changed(pan={"kind": "position", "unit": "degrees"})).of(SPEC)


def test_suggested_limits_hold_what_the_robot_did():
    t = np.arange(100) / 20
    rows = np.stack([np.sin(t), 0.1 * np.cos(3 * t)], 1)
    limits = Limits.suggest(SPEC, {"pan": "position", "grip": "difference"}, rows, 20, margin=1.1, refuse_above=0)
    pan, grip = limits.columns
    assert pan.velocity == pytest.approx(1.1, rel=0.01) and pan.acceleration == pytest.approx(1.1, rel=0.01)
    assert grip.velocity == pytest.approx(1.1 * 0.1 * 20, rel=0.01) and grip.unit == ""
    assert not Limiter(limits, 20).breaks(rows).any()
    tight = Limits.suggest(SPEC, {"pan": "position", "grip": "difference"}, rows / 2, 20, margin=1, refuse_above=0)
    assert Limiter(tight, 20).breaks(rows).mean() > 0.5
    with pytest.raises(UsageError, match="without grip"):
        Limits.suggest(SPEC, {"pan": "position"}, rows, 20, margin=1, refuse_above=0)


def test_of_a_gripper_the_ends_alone_are_suggested():
    rows = np.stack([np.sin(np.arange(40) / 20), np.repeat([0.0, 1.0], 20)], 1)
    kinds = {"pan": "position", "grip": "gripper"}
    grip = Limits.suggest(SPEC, kinds, rows, 20, margin=1.5, refuse_above=0).columns[1]
    assert grip == Column("grip", "gripper", "", 0, 1)
    still = Limits.suggest(SPEC, kinds, rows[:20], 20, margin=1.5, refuse_above=0).columns[1]
    assert still == Column("grip", "gripper")

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
from vla_cpp.eval import report
from vla_cpp.eval.episode import Outcome

HEAD = {"environment": "null", "a": "A", "b": "", "rate_hz": 80.0, "replan_every": 8}


def outcome(solved=True, swapped=False, engine_ms=2.0, seed=1, driver="a", difference=(), task="drift"):
    return Outcome(
        task=task, seed=seed, driver=driver, sentence="go", swapped=swapped, solved=solved, steps=8, clipped=0, replan_every=8,
        round_trip_ms=[engine_ms + 1], engine_ms=[engine_ms], difference=list(difference),
    )  # fmt: skip


def test_a_run_with_the_opposite_sentence_has_no_empty_table_of_success():
    data = report.summary([outcome(solved=False, swapped=True)], HEAD)
    assert "success" not in data and data["swapped"]["all"]["solved"] == 0 and data["swapped"]["all"]["episodes"] == 1
    assert report.markdown(data).count("| all |") == 1


def test_both_drivers_of_a_swapped_run_have_a_table():
    rows = [outcome(swapped=True, driver=driver) for driver in ("a", "b")]
    data = report.summary(rows, {**HEAD, "b": "B"})
    assert data["swapped"]["all"]["episodes"] == data["swapped_b"]["all"]["episodes"] == 1
    assert data["paired"]["both"] == 1


def test_latency_is_told_where_something_was_inferred_and_only_there():
    assert "A replan takes 3.0 ms" in report.markdown(report.summary([outcome()], HEAD))
    assert "A replan takes" not in report.markdown(report.summary([outcome(engine_ms=0.0)], HEAD))


def test_looks_are_counted_from_one_and_only_episodes_that_got_so_far_count():
    table = report.differences([outcome(difference=[1.0, 4.0]), outcome(difference=[3.0], seed=2)])
    assert [(row["look"], row["chunks"], row["max"]) for row in table] == [(1, 2, 3.0), (2, 1, 4.0)]


def test_smoothness_is_a_table_of_both_policies_where_it_was_measured():
    rows = [outcome(), outcome(driver="b")]
    rows[0].smoothness, rows[1].smoothness = {"jerk": 0.25}, {"jerk": 0.5, "gripper_flips": 2.0}
    data = report.summary(rows, {**HEAD, "b": "B"})
    assert data["smoothness"] == {"jerk": 0.25} and data["smoothness_b"]["gripper_flips"] == 2
    text = report.markdown(data)
    assert "| executed actions | jerk | gripper flips |" in text and "| A | 0.25 |  |" in text and "| B | 0.5 | 2 |" in text
    assert "executed actions" not in report.markdown(report.summary([outcome()], HEAD))


def test_suites_are_counted_after_their_tasks():
    rows = [outcome(task="b/1", solved=False), outcome(task="a/0"), outcome(task="b/0"), outcome(task="b/1", seed=2)]
    table = report.by_task(rows)
    counts = {name: (row["solved"], row["episodes"]) for name, row in table.items()}
    assert list(counts.items()) == [("b/1", (1, 2)), ("b/0", (1, 1)), ("b", (2, 3)), ("a/0", (1, 1)), ("a", (1, 1)), ("all", (3, 4))]
    assert list(report.by_task([outcome()])) == ["drift", "all"]


def test_a_paired_run_has_the_table_of_both():
    rows = [outcome(driver="a"), outcome(driver="b", solved=False)]
    text = report.markdown(report.summary(rows, {**HEAD, "b": "B"}))
    assert "| drift | 1/1 |" in text and "| drift | 0/1 |" in text

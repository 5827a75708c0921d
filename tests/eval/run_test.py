# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Whole runs at a real server, in the world that needs no simulator."""

import json
import os
import queue
import signal
import subprocess
import sys
import time

import pytest
from vla_cpp.eval import runner
from vla_cpp.eval.cli import _jobs, build_parser, main
from vla_cpp.eval.environments.null import Null
from vla_cpp.eval.episode import Job
from vla_cpp.eval.serving import Server


@pytest.fixture
def call(bundle, binary, tmp_path):
    """Arguments of a small run; more can be added."""

    def arguments(out, *more, episodes=4):
        given = ["--bundle", str(bundle), "--vla", str(binary)] if "--server" not in more else []
        return ["null", *given, "--episodes", str(episodes), "--out", str(tmp_path / out), "--quiet", *more]

    return arguments


def rows_of(folder):
    lines = (folder / "episodes.jsonl").read_text().splitlines()
    assert "run" in json.loads(lines[0])
    return [json.loads(line) for line in lines[1:]]


def outcomes(folder):
    """What a run found, without the times."""
    rows = [{k: v for k, v in row.items() if not k.endswith("_ms")} for row in rows_of(folder)]
    return sorted(rows, key=lambda row: (row["driver"], row["task"], row["seed"]))


def last_object(text):
    return json.loads(text.strip().splitlines()[-1])


def test_a_run_counts_each_task_and_writes_table_and_episodes(call, tmp_path, capsys):
    assert main([*call("run"), "--json"]) == 0
    data = last_object(capsys.readouterr().out)
    assert data["success"]["drift"]["episodes"] == data["success"]["still"]["episodes"] == 4
    assert data["success"]["drift"]["solved"] == 4 and data["success"]["still"]["solved"] == 0
    assert data["success"]["all"]["rate"] == 0.5
    rows = rows_of(tmp_path / "run")
    assert len(rows) == 8 and {row["bundle"] for row in rows} == {data["run"]["a_identity"]}
    assert all(len(row["engine_ms"]) == len(row["round_trip_ms"]) == -(-row["steps"] // 8) for row in rows)
    assert all(trip >= engine for row in rows for trip, engine in zip(row["round_trip_ms"], row["engine_ms"]))
    assert data["latency"]["replans"] == sum(len(row["engine_ms"]) for row in rows)
    assert "| still | 0/4 | 0.0 % | 0.0 to 49.0 % |" in (tmp_path / "run/summary.md").read_text()


def test_a_run_that_was_killed_goes_on_and_ends_with_the_same_table(call, tmp_path, capsys):
    assert main([*call("whole", episodes=12), "--json"]) == 0
    whole = last_object(capsys.readouterr().out)
    command = [sys.executable, "-m", "vla_cpp.eval.cli", *call("cut", "--workers", "1", episodes=12)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    child = subprocess.Popen(command, env=environment)
    journal = tmp_path / "cut/episodes.jsonl"
    until = time.monotonic() + 120
    while not journal.exists() or journal.read_bytes().count(b"\n") < 4:
        assert child.poll() is None and time.monotonic() < until, "no episode was written"
        time.sleep(0.01)
    child.send_signal(signal.SIGKILL)
    child.wait()
    kept = len(rows_of(tmp_path / "cut"))
    assert 3 <= kept < 24
    with journal.open("ab") as file:
        file.write(b'{"task": "dri')  # what a kill in the middle of a write leaves
    assert main([*call("cut", episodes=12), "--json"]) == 0
    resumed = last_object(capsys.readouterr().out)
    assert resumed["success"] == whole["success"]
    assert outcomes(tmp_path / "cut") == outcomes(tmp_path / "whole")


def test_a_server_that_dies_is_reported_and_its_episode_not_counted(call, bundle, binary, tmp_path, capsys):
    with Server(str(binary), bundle, threads=1) as server:
        command = [sys.executable, "-m", "vla_cpp.eval.cli", *call("died", "--server", server.address, "--workers", "1", episodes=30)]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
        child = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE)
        journal = tmp_path / "died/episodes.jsonl"
        until = time.monotonic() + 120
        while not journal.exists() or journal.read_bytes().count(b"\n") < 3:
            assert child.poll() is None and time.monotonic() < until, "no episode was written"
            time.sleep(0.01)
        os.kill(server.pid, signal.SIGKILL)
        told = child.communicate(timeout=90)[1].decode()
    assert child.returncode == 9, told
    assert server.address in told and "the same command runs the missing ones" in told
    kept = len(rows_of(tmp_path / "died"))
    assert kept < 60
    with Server(str(binary), bundle, threads=1) as server:
        assert main(call("died", "--server", server.address, episodes=30)) == 0
    assert main(call("whole", episodes=30)) == 0
    assert outcomes(tmp_path / "died") == outcomes(tmp_path / "whole")


def test_the_table_does_not_depend_on_the_order_in_which_episodes_ended(call, tmp_path, capsys):
    assert main([*call("order"), "--json"]) == 0
    told = last_object(capsys.readouterr().out)
    journal = tmp_path / "order/episodes.jsonl"
    head, *rows = journal.read_text().splitlines(keepends=True)
    journal.write_text(head + "".join(reversed(rows)))
    assert main([*call("order"), "--json"]) == 0
    again = last_object(capsys.readouterr().out)
    assert json.dumps(again["success"]) == json.dumps(told["success"])  # as text: the order of the tasks counts too


def test_episodes_of_another_run_are_not_mixed_in(call, capsys):
    assert main(call("one")) == 0
    assert main(call("one", "--replan-every", "4")) == 9
    assert "replan_every: there 8, now 4" in capsys.readouterr().err


def test_a_bundle_paired_with_itself_agrees_in_every_chunk(call, bundle, tmp_path, capsys):
    assert main([*call("pair", "--against", str(bundle), "--paired"), "--json"]) == 0
    data = last_object(capsys.readouterr().out)
    assert data["paired"]["both"] == 4 and data["paired"]["neither"] == 4
    assert data["paired"]["only_a"] == data["paired"]["only_b"] == 0 and data["paired"]["mcnemar_p"] == 1
    assert data["paired"]["same_length"] == 8 and data["paired"]["discordant"] == []
    assert data["differences"] and all(row["max"] == 0 for row in data["differences"])


@pytest.mark.parametrize("more", [[], ["--mode", "rtc", "--latency-ms", "300"]])
def test_one_robot_of_several_is_evaluated_as_its_bundle_alone(call, robots, tmp_path, more):
    two = ["--bundle", str(robots), "--embodiment"]
    assert main(call("alone", *more)) == main(call("left", *two, "left", *more)) == 0
    told = [[{**row, "bundle": ""} for row in outcomes(tmp_path / out)] for out in ("alone", "left")]
    assert told[0] == told[1]
    assert main(call("left", *two, "right", *more)) == 9  # episodes of another robot are not mixed in


def test_a_pair_of_robots_is_two_of_the_same_tag(call, robots, capsys):
    assert main([*call("pair", "--bundle", str(robots), "--embodiment", "left", "--against", str(robots), "--paired"), "--json"]) == 0
    data = last_object(capsys.readouterr().out)
    assert data["run"]["a"].startswith("two.gguf for left, computed in")
    assert all(row["max"] == 0 for row in data["differences"])


@pytest.mark.parametrize("command", ["null", "replan", "demo"])
@pytest.mark.parametrize("given, found", [([], "none"), (["--embodiment", "cat"], "cat")])
def test_a_robot_that_is_not_named_or_not_there_is_refused_with_the_list(robots, binary, tmp_path, capsys, command, given, found):
    call = [command, "--bundle", str(robots), "--vla", str(binary), "--out", str(tmp_path), *given]
    assert main([*call, *(["--environment", "null"] if command == "replan" else [])]) == 2
    assert f"vla-eval: embodiment: expected one of left, right, found {found}; vla-eval --help" in capsys.readouterr().err


def test_a_pair_that_differs_is_told_episode_by_episode(call, tmp_path, capsys):
    assert main([*call("random", "--against", "random", "--paired"), "--json"]) == 0
    data = last_object(capsys.readouterr().out)
    assert data["paired"]["only_a"] == len([row for row in data["paired"]["discordant"] if row["a"]])
    assert all(row["max"] > 0 for row in data["differences"])


# Eight steps of each chunk; where the robot waits, three more at each look but the first.
@pytest.mark.parametrize("mode, n_look", [("sync", 4), ("async", 5), ("rtc", 5)])
def test_chunks_that_come_late_cost_the_robot_the_steps_that_the_mode_says(call, tmp_path, mode, n_look):
    late = ["--mode", mode, "--latency-ms", "300", "--task", "still"]  # three steps at 10 Hz
    assert main(call(mode, *late, episodes=2)) == 0
    assert main(call(mode + "-again", *late, "--workers", "1", episodes=2)) == 0
    assert outcomes(tmp_path / mode) == outcomes(tmp_path / (mode + "-again"))
    for row in rows_of(tmp_path / mode):
        assert row["steps"] == 40 and row["round_trip_ms"] == [300.0] * n_look
        assert row["facts"]["held"] == 0  # the chunk before had rows enough


def test_a_chunk_later_than_the_one_before_lasts_leaves_the_robot_without_an_action(call, tmp_path):
    assert main(call("late", "--mode", "async", "--latency-ms", "1500", "--task", "still", episodes=1)) == 0
    (row,) = rows_of(tmp_path / "late")
    assert row["facts"]["held"] > 0
    assert json.loads((tmp_path / "late/episodes.jsonl").read_text().splitlines()[0])["run"]["latency_ms"] == 1500


def test_the_replan_study_has_a_row_for_each_interval(bundle, binary, tmp_path, capsys):
    call = ["replan", "--environment", "null", "--bundle", str(bundle), "--vla", str(binary), "--intervals", "4,16", "--task", "still"]
    assert main([*call, "--episodes", "2", "--out", str(tmp_path), "--quiet", "--json"]) == 0
    data = last_object(capsys.readouterr().out)
    assert [row["replan_every"] for row in data["intervals"]] == [4, 16]
    assert [row["latency"]["replans"] for row in data["intervals"]] == [2 * 10, 2 * 3]  # 40 steps an episode


def test_suites_become_episodes_task_by_task():
    arguments = build_parser().parse_args(["libero", "--random", "--suite", "object,libero_goal_swap", "--episodes", "2", "--seed", "7"])
    jobs = [(job.task, job.seed) for job in _jobs("libero", arguments)]
    assert jobs[:3] == [("libero_object/0", 7), ("libero_object/0", 8), ("libero_object/1", 7)]
    assert jobs[-1] == ("libero_goal_swap/9", 8) and len(jobs) == 40
    study = build_parser().parse_args(["replan", "--environment", "libero", "--random", "--suite", "object", "--episodes", "1"])
    assert [job.task for job in _jobs("libero", study)] == [f"libero_object/{i}" for i in range(10)]


def test_a_large_task_is_closed_before_the_next_is_made(monkeypatch, tmp_path):
    closed = []
    monkeypatch.setattr(Null, "one_at_a_time", True)
    monkeypatch.setattr(Null, "close", lambda self: closed.append(self.task))
    description = {"a": {"kind": "random", "horizon": 8, "d_action": 4}}
    jobs, results = queue.Queue(), queue.Queue()
    for job in (Job("still", 1), Job("still", 2), Job("drift", 1), None):
        jobs.put(job)
    monkeypatch.setattr(runner, "die_with_parent", lambda: None)
    monkeypatch.setattr(runner.os, "_exit", lambda code: None)
    results.close = results.join_thread = lambda: None
    runner._work(runner.Plan("null", {}, description, None, 8), jobs, results)
    assert [results.get_nowait()[0] for _ in range(4)] == ["done"] * 3 + ["end"] and closed == ["still"]


@pytest.mark.parametrize(
    "more, told",
    [
        (["--task", "fly"], "null has no task 'fly'; there are: drift, still"),
        (["--episodes", "0"], "take 1 or more"),
        (["libero", "--suite", "object,moon"], "--suite: libero has no 'moon'; there are: spatial, object, goal, 10, spatial_lan"),
        (["replan", "--suite", "object"], "--suite: metaworld has no 'object'; it has no suites"),
        (["libero"], "libero has 290 tasks: give --suite or --task"),
        (["libero", "--task", "libero_goal/10"], "libero has no task 'libero_goal/10'; there are: libero_spatial/0 to 9"),
        (["--against", "random"], "go together"),
        (["--swap"], "has an opposite"),
        (["--server", "", "--bundle", "", "--random", "--embodiment", "left"], "--embodiment goes with --bundle or --server"),
        (["--latency-ms", "-1"], "--latency-ms: expected 0 or more, found -1"),
        (["--mode", "rtc", "--film", "all"], "--mode and --latency-ms go with --bundle or --server"),
    ],
)
def test_a_wrong_call_says_what_is_wrong(call, more, told, capsys):
    arguments = [*more, "--random"] if more[0] in ("libero", "replan") else call("wrong", *more)
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2 and told in capsys.readouterr().err


def test_a_bundle_that_is_none_is_reported_with_what_the_server_says(binary, tmp_path, capsys):
    (tmp_path / "no.gguf").write_bytes(b"no")
    assert main(["null", "--bundle", str(tmp_path / "no.gguf"), "--vla", str(binary), "--out", str(tmp_path), "--quiet"]) == 9
    assert "bad_bundle" in capsys.readouterr().err


def test_a_package_that_is_missing_is_named_with_what_installs_it():
    script = "import sys; sys.modules['rich'] = None; from vla_cpp.eval.cli import main; sys.exit(main(['demo']))"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    result = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True)
    assert result.returncode == 9 and result.stderr == "vla-eval: the module rich is missing; at the root of vla.cpp: pip install './python[eval]'\n"


def test_random_actions_are_as_wide_as_the_environment_says():
    import argparse

    import numpy as np
    from vla_cpp.eval import run
    from vla_cpp.eval.policies import make_policy

    driver = run.Policies(argparse.Namespace()).named("random")
    run.size_random([driver, None], 7)
    policy = make_policy(driver.description)
    noise = np.zeros(policy.noise_shape, np.float32)
    assert policy.act(None, "", noise).actions.shape == (16, 7)

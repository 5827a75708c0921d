# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""examples/python/arm.py on its simulated arm: within limits, slower where asked to, taken over and recorded."""

import json
import os
import subprocess
import sys
import time

import numpy as np
import pytest
from check_robot_test import SO101, bundle_of, named
from server_process import ROOT, SECONDS, Server

from vla_cpp.control import Column, Limits
from vla_cpp.control.episodes import episodes_of

sys.path.append(str(ROOT / "examples/python"))
import arm  # noqa: E402


@pytest.fixture
def served(tmp_path):
    """A policy with the names of an SO-101, at a server."""
    bundle = bundle_of(tmp_path, "pi05/wide_state", **named(SO101, ["degrees"] * 5 + [""]))
    server = Server(type("Case", (), {"bundle": bundle}))
    yield server.address
    assert server.stop() == 0


def limits_file(tmp_path):
    joint = {"kind": "position", "unit": "degrees", "range": [-3, 3], "velocity": 1.5, "acceleration": 20}
    columns = {**{name: joint for name in SO101[:5]}, SO101[5]: {"kind": "gripper", "unit": "", "range": [-1, 1]}}
    (tmp_path / "limits.json").write_text(json.dumps({"format": "vla-limits 1", "columns": columns, "refuse_above": 1.0}))
    return tmp_path / "limits.json"


def start(tmp_path, address, *options):
    command = [sys.executable, ROOT / "examples/python/arm.py", address, limits_file(tmp_path), "--arm", "simulated", "--camera", "front="]
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "python")}
    options = ["--text", "pick up the cube", "--replan-every", 3, "--episodes", tmp_path / "episodes", *options]
    return subprocess.Popen([*command, *map(str, options)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)


def test_a_person_takes_over_and_the_episode_says_so(served, tmp_path):
    process = start(tmp_path, served, "--speed", 1, "--seconds", 30)
    seen = []
    for word, line in ((None, "policy"), ("t", "person"), ("t", "policy")):
        if word:
            process.stdin.write(word + "\n")
            process.stdin.flush()
        until = time.monotonic() + SECONDS
        while not (seen and line in seen[-1]) and time.monotonic() < until:
            seen.append(process.stdout.readline())
        assert line in seen[-1], seen
        time.sleep(0.5)
    out, err = process.communicate("s\n", timeout=SECONDS)
    assert process.returncode == 0, err
    (episode,) = episodes_of(tmp_path / "episodes")
    frames = list(episode)
    assert episode.header.success is True and episode.header.rate_hz == 30
    human = np.array([frame["human"] for frame in frames])
    assert human.any() and not human[0] and not human[-1]
    commands = np.array([frame["action"] for frame in frames], float)
    joints = commands[:, :5]
    ticks = np.array([frame["tick"] for frame in frames])
    step = np.diff(joints, axis=0)[np.diff(ticks) == 1]
    assert np.abs(step).max() <= 1.5 / 30 * 1.001 and np.ptp(joints) > 0.05


def test_a_tenth_of_the_speed_is_a_tenth_of_the_rate(served, tmp_path):
    process = start(tmp_path, served, "--speed", 0.1, "--seconds", 4)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    (episode,) = episodes_of(tmp_path / "episodes")
    assert episode.header.rate_hz == 3 and 10 <= episode.n_frame <= 12 and episode.header.success is None


def test_limits_of_a_slower_motion():
    limits = Limits((Column("x", "position", "", -1, 1, 2, 30, 400), Column("g", "gripper", "", 0, 1)), 0.5)
    slow = arm.slower(limits, 0.1)
    assert slow.columns[0] == Column("x", "position", "", -1, 1, pytest.approx(0.2), pytest.approx(0.3), pytest.approx(0.4))
    assert slow.columns[1] == limits.columns[1] and slow.refuse_above == 0.5


def test_limits_that_do_not_hold_the_arm_are_told(served, tmp_path):
    process = start(tmp_path, served, "--speed", 1, "--seconds", 1, "--start", "9,0,0,0,0,0")
    out, err = process.communicate(timeout=SECONDS)
    assert process.returncode == 1 and "limits.shoulder_pan.pos: expected -3" in err and "where the robot is" in err
    assert not list((tmp_path / "episodes").glob("episode_*"))

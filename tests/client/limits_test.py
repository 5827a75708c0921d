# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""vla serve --limits: rows outside are counted, told, shown and recorded, or refused; the rest stays as it is."""

import json
import subprocess
import urllib.request

import numpy as np
import pytest
from page_test import Shown
from server_process import ROOT, SECONDS, VLA

import vla_cpp
from vla_cpp.control import Limiter, Limits

BUNDLE = ROOT / "models/metaworld-tiny.gguf"
FRAME = (ROOT / "examples/metaworld/episodes/drawer-close/step_00.png").read_bytes()
OBSERVATION = dict(images={"observation.images.corner4": FRAME}, state=[0.0, 0.6, 0.2, 1.0], text="drawer-close")


@pytest.fixture(scope="module")
def rows():
    """The policy's answer, without limits."""
    with vla_cpp.Policy(str(BUNDLE), threads=1) as policy:
        return policy.act(**OBSERVATION, seed=1).actions


def limits_of(rows, refuse_above):
    """Some rows of the first column are outside, by its range or by its velocity."""
    low, high = np.quantile(rows[:, 0], (0.2, 0.8))
    dx = {"kind": "position", "unit": "", "range": [float(low), float(high)], "velocity": float(80 * np.abs(np.diff(rows[:, 0])).max() * 0.9)}
    free = {"kind": "difference", "unit": ""}
    columns = {"gripper": {"kind": "gripper", "unit": ""}, "dz": free, "dy": free, "dx": dx}
    return {"format": "vla-limits 1", "columns": columns, "refuse_above": refuse_above}


@pytest.fixture
def serve(tmp_path, rows):
    """A server with these limits and a page, and a client."""
    shown = []

    def start(what, refuse_above, *options, wanted=rows):
        (tmp_path / "limits.json").write_text(json.dumps(limits_of(wanted, refuse_above)))
        limited = ["--limits", str(tmp_path / "limits.json"), "--on-limit", what]
        server = Shown("serve", str(BUNDLE), "--bind", "tcp://127.0.0.1:0", "--threads", "1", "--metrics", "127.0.0.1:0", *limited, *options)
        server.robot = vla_cpp.Client(server.told["address"], timeout=SECONDS)
        shown.append(server)
        return server

    yield start
    for server in shown:
        assert server.stop() == 0


def counted(server):
    """The metrics of limits, as soon as the last act is in them."""
    server.acts()
    with urllib.request.urlopen(f"http://{server.told['metrics']}/metrics", timeout=SECONDS) as reply:
        lines = [line for line in reply.read().decode().splitlines() if "beyond_limits" in line and line[0] != "#"]
    return {name: float(value) for name, value in (line.split() for line in lines)}


def test_rows_outside_are_noted_and_stay_as_they_are(serve, rows, tmp_path):
    server = serve("note", 0.9, "--record", str(tmp_path / "recording"))
    server.n_act = 1
    chunk = server.robot.act(**OBSERVATION, seed=1)
    broken = Limiter(Limits.parse(limits_of(rows, 0.9)).of(server.robot.spec), 80).breaks(rows)
    n = int(broken.sum())
    assert 0 < n < 14 and chunk.actions.tobytes() == rows.tobytes()
    assert chunk.notes[-1] == f"limits: rows are outside: {n} of 16, from row {int(np.argmax(broken))} on: dx ({n})"
    outcomes = {'vla_chunks_beyond_limits_total{outcome="noted"}': 1, 'vla_chunks_beyond_limits_total{outcome="refused"}': 0}
    assert counted(server) == {"vla_rows_beyond_limits_total": n, **outcomes}
    dx, dy, *_ = json.loads(server.get("policy")[2])["robots"][0]["actions"]
    assert [dx["low"], dx["high"]] == pytest.approx(np.quantile(rows[:, 0], (0.2, 0.8))) and "low" not in dy
    assert server.acts()["acts"][0]["chunk"]["notes"] == list(chunk.notes)
    assert server.stop() == 0
    replay = [VLA, "replay", tmp_path / "recording", "--bundle", BUNDLE]
    same = subprocess.run([*replay, "--limits", tmp_path / "limits.json", "--on-limit", "note"], capture_output=True, text=True)
    assert same.returncode == 0, same.stdout
    other = subprocess.run(replay, capture_output=True, text=True)
    assert other.returncode == 10 and "limits: rows are outside" in other.stdout


@pytest.mark.parametrize("what, refuse_above, words", [("refuse", 0.9, "no row outside of the limits"), ("note", 0.01, "at most a share of 0.01 of its rows")])
def test_a_chunk_outside_is_refused(serve, what, refuse_above, words):
    server = serve(what, refuse_above)
    server.n_act = 1
    with pytest.raises(vla_cpp.BadAction, match=f"{words}.*, found [0-9]+ of 16, from row [0-9]+ on: dx"):
        server.robot.act(**OBSERVATION, seed=1)
    found = counted(server)
    assert found.pop("vla_rows_beyond_limits_total") > 0
    assert found == {'vla_chunks_beyond_limits_total{outcome="noted"}': 0, 'vla_chunks_beyond_limits_total{outcome="refused"}': 1}
    assert server.acts()["acts"][0]["code"] == "bad_action"


def test_a_chunk_inside_is_answered_without_a_note(serve, rows):
    server = serve("refuse", 0.5, wanted=100 * rows)
    assert not [note for note in server.robot.act(**OBSERVATION, seed=1).notes if note.startswith("limits")]


@pytest.mark.parametrize(
    "change, what, words",
    [
        ({}, "clamp", "a server does not know where the robot is when a row is commanded"),
        ({}, "warn", "expected note or refuse"),
        ({}, None, "--on-limit"),
        ({"dx": None}, "note", "expected the actions of metaworld-tiny.gguf: dx, dy, dz, gripper, found gripper, dz, dy"),
        ({"roll": {"kind": "difference", "unit": ""}}, "note", "dx, dy, dz, gripper, found gripper, dz, dy, dx, roll"),
        ({"dx": {"kind": "place", "unit": ""}}, "note", "one of position, velocity, difference, gripper"),
    ],
)
def test_what_does_not_fit_is_refused_at_the_start(rows, tmp_path, change, what, words):
    document = limits_of(rows, 0.5)
    document["columns"] = {name: column for name, column in {**document["columns"], **change}.items() if column}
    (tmp_path / "limits.json").write_text(json.dumps(document))
    on_limit = ["--on-limit", what] if what else []
    command = [VLA, "serve", BUNDLE, "--bind", "tcp://127.0.0.1:0", "--limits", tmp_path / "limits.json", *on_limit]
    done = subprocess.run(command, capture_output=True, text=True, timeout=SECONDS)
    assert done.returncode == 2 and words in done.stderr and done.stdout == ""

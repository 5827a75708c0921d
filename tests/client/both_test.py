# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""A policy at a server and the same policy in process are used alike: the example program and the control loop take either."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from golden_cases import NAMES, Golden
from server_process import SECONDS, VLA, Server, frames, ran

import vla_cpp
from vla_cpp.control import ChunkLoop

ROOT = Path(__file__).resolve().parents[2]


def test_the_specs_are_equal(case, server):
    with vla_cpp.Client(server.address, timeout=SECONDS) as client, vla_cpp.Policy(case.bundle, threads=1) as policy:
        assert client.spec == policy.spec


def test_the_chunk_is_that_of_vla_run(policy, case, tmp_path):
    chunk = policy.act(images=frames(case), state=case.state, text=case.text, seed=5)
    assert np.asarray(chunk).tobytes() == ran(case, tmp_path, "--seed", "5").tobytes()


def test_a_camera_that_stopped_is_noticed_while_the_state_moves(policy, case):
    pictures, state = frames(case), np.array(case.state, np.float32)

    def notes(moved, images):
        return [n for n in policy.act(images=images, state=state + moved, text=case.text, seed=1).notes if "camera still run" in n]

    assert not any(notes(0.0, pictures) for _ in range(8)), "a robot that rests"
    assert not any(notes(0.01 * i, {v: p if p is None else p + np.uint8(i) for v, p in pictures.items()}) for i in range(8))
    found = [notes(0.01 * i, pictures) for i in range(8)]
    assert found[:4] == [[]] * 4 and all(len(n) == len([p for p in pictures.values() if p is not None]) for n in found[4:])
    assert "view camera1: the same picture in 5 acts" in found[4][0]


@pytest.mark.parametrize("value, note", [(0, "all pixels are alike"), (200, "all pixels are alike"), (None, "0 or 1")])
def test_a_picture_that_no_camera_takes_is_noticed(policy, case, value, note):
    pictures = frames(case)
    picture = pictures["camera1"]
    pictures["camera1"] = picture // 128 if value is None else np.full_like(picture, value)
    (found,) = policy.act(images=pictures, state=case.state, text=case.text, seed=1).notes
    assert found.startswith("observation.images.camera1: ") and note in found


@pytest.mark.parametrize("name", NAMES)
def test_server_library_and_program_give_the_same_bytes(name, tmp_path):
    case = Golden(name)
    observation = {"images": frames(case), "state": case.state, "text": case.text}
    seed, noise = 2**64 - 5, np.load(case.noise)
    server = Server(case)
    with vla_cpp.Client(server.address, timeout=SECONDS) as client, vla_cpp.Policy(case.bundle, threads=1) as library:
        for start, option in (({"seed": seed}, ("--seed", str(seed))), ({"noise": noise}, ("--noise", case.noise))):
            expected = ran(case, tmp_path, *option)
            for policy in (client, library):
                assert np.asarray(policy.act(**observation, **start)).tobytes() == expected.tobytes()
    assert server.stop() == 0


BAD_PARTS = {  # what is wrong, and the place that every door tells
    "observation.images.camera1": dict(images={"camera1": b"\x89PNG\r\n\x1a\nbroken", "camera2": None}),
    "observation.images.camera2": dict(images={"camera1": None}),
    "views": dict(images={"camera1": None, "camera2": None}),
    'view "nose"': dict(images={"nose": None}),
    "observation.state": dict(state=[0.0] * 5),
    "observation.state[4]": dict(state=[0.0] * 4 + [float("nan"), 0.0]),
    'state "arm"': dict(state={"arm": [0.0] * 6}),
    "instruction": dict(text=None),
    "noise": dict(noise=np.zeros((8, 5), np.float32)),
    "leftover": dict(leftover=vla_cpp.Leftover(np.zeros((6, 7), np.float32), 0, "linear", 5.0)),
}


@pytest.mark.parametrize("part", BAD_PARTS)
def test_server_and_library_name_the_part_of_an_observation_that_is_wrong(policy, case, part):
    observation = {"images": frames(case), "state": case.state, "text": case.text, **BAD_PARTS[part]}
    with pytest.raises(vla_cpp.BadObservation) as caught:
        policy.act(**observation)
    assert caught.value.where == part


@pytest.mark.parametrize("part", BAD_PARTS)
def test_vla_run_names_it_alike(case, tmp_path, part):
    given, more = dict(BAD_PARTS[part]), []
    if leftover := given.pop("leftover", None):
        np.save(tmp_path / "rows.npy", leftover.rows)
        more = ["--leftover", tmp_path / "rows.npy", "--delay", "0", "--schedule", "linear", "--max-guidance", "5"]
    if "noise" in given:
        np.save(tmp_path / "noise.npy", given["noise"])
        given["noise"] = tmp_path / "noise.npy"
    if state := given.get("state"):
        by_name = state.items() if isinstance(state, dict) else [("state", state)]
        given["state"] = ";".join(f"{name}={','.join(map(str, numbers))}" for name, numbers in by_name)
    for view, data in given.get("images", {}).items():
        if data is not None:
            (tmp_path / view).write_bytes(data)
            given["images"] = {**given["images"], view: tmp_path / view}
    call = [VLA, *case.arguments(**given, options=more)]
    if "text" in given:  # none is given
        at = call.index("--text")
        del call[at : at + 2]
    result = subprocess.run(list(map(str, call)), capture_output=True, text=True)
    assert result.returncode == 4 and result.stderr.startswith(f"error: bad_observation: {part}: "), result.stderr


def test_a_leftover_gives_the_same_bytes_from_server_library_and_program(policy, case, tmp_path):
    observation = {"images": frames(case), "state": case.state, "text": case.text}
    assert policy.spec.real_time_chunking == "guided"
    ran(case, tmp_path, "--seed", "5", "--normalized-out", str(tmp_path / "normalized.npy"))
    before = policy.act(**observation, seed=5)
    assert before.normalized.tobytes() == np.load(tmp_path / "normalized.npy").tobytes()
    rows = before.normalized[2:]
    np.save(tmp_path / "rows.npy", rows)
    settings = ["--leftover", str(tmp_path / "rows.npy"), "--delay", "1", "--schedule", "exp", "--max-guidance", "2.5"]
    expected = ran(case, tmp_path, "--seed", "6", *settings)
    after = policy.act(**observation, seed=6, leftover=vla_cpp.Leftover(rows, 1, "exp", 2.5))
    assert np.asarray(after).tobytes() == expected.tobytes() != ran(case, tmp_path, "--seed", "6").tobytes()
    # The row that is executed meanwhile is nearer to what was planned than without it.
    alone = policy.act(**observation, seed=6)
    assert np.abs(after.normalized[0] - rows[0]).max() < np.abs(alone.normalized[0] - rows[0]).max() / 2


@pytest.mark.parametrize(
    "change, part",
    [
        ({"rows": np.zeros((6, 7))}, "1 to 5 rows of 7"),
        ({"rows": np.zeros((2, 6))}, "1 to 5 rows of 7"),
        ({"delay": 3}, "leftover.delay"),
        ({"delay": 0.5}, "leftover.delay"),
        ({"schedule": None}, "leftover.schedule"),
        ({"schedule": "steep"}, "zeros, ones, linear or exp"),
        ({"max_guidance": None}, "leftover.max_guidance"),
        ({"max_guidance": -1.0}, "leftover.max_guidance"),
    ],
)
def test_a_leftover_that_cannot_be_meant_is_refused(policy, case, change, part):
    leftover = {"rows": np.zeros((2, 7)), "delay": 1, "schedule": "linear", "max_guidance": 5.0, **change}
    with pytest.raises(vla_cpp.BadObservation, match=part):
        policy.act(images=frames(case), state=case.state, text=case.text, leftover=vla_cpp.Leftover(**leftover))


def example(where, case, *more):
    images = [a for view, file in case.images.items() for a in ("--image", f"{view}={file or ''}")]
    state = ",".join(map(repr, case.state))
    command = [sys.executable, ROOT / "examples/python/act.py", where, *images, "--state", state, "--text", case.text]
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "python")}
    return subprocess.run([*map(str, command), *more], capture_output=True, text=True, env=environment)


def test_the_example_prints_and_writes_the_chunk(where, case, tmp_path):
    result = example(where, case, "--seed", "5", "--out", str(tmp_path / "chunk.npy"))
    assert result.returncode == 0 and "seed 5: 5 rows of action.0" in result.stdout, result.stderr
    assert np.load(tmp_path / "chunk.npy").tobytes() == ran(case, tmp_path, "--seed", "5").tobytes()


def test_the_example_says_what_is_wrong(where, case):
    result = example(where, case, "--state", "1,2")
    assert result.returncode == 1 and result.stdout == ""
    assert result.stderr.startswith("error: observation.state: expected 6 ") and "Traceback" not in result.stderr


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_a_control_loop_runs_on_it(policy, case, mode):
    observation = dict(images=frames(case), state=case.state, text=case.text)
    with ChunkLoop(policy, rate_hz=50, replan_every=3, mode=mode, blend="ensemble", on_late="hold", on_note="raise") as loop:
        loop.begin(observation)
        actions = []
        for _ in range(30):
            actions.append(loop.step(observation))
            loop.pace()
    assert all(a.values.shape == (7,) and np.isfinite(a.values).all() for a in actions)
    assert loop.stats["chunks"] >= 3 and loop.last_error is None
    assert {a.chunk.bundle for a in actions if not a.held} == {policy.spec.bundle}

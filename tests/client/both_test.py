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
from server_process import SECONDS, Server, frames, ran

import vla_cpp
from vla_cpp.control import ChunkLoop

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def case():
    return Golden("two_views")


@pytest.fixture(scope="module")
def server(case):
    server = Server(case)
    yield server
    server.stop()


@pytest.fixture(params=["server", "process"])
def where(request, case, server):
    """What the example takes, and `vla_cpp` makes a policy of."""
    return server.address if request.param == "server" else str(case.bundle)


@pytest.fixture
def policy(where):
    with vla_cpp.Client(where, timeout=SECONDS) if "://" in where else vla_cpp.Policy(where, threads=1) as policy:
        yield policy


def test_the_specs_are_equal(case, server):
    with vla_cpp.Client(server.address, timeout=SECONDS) as client, vla_cpp.Policy(case.bundle, threads=1) as policy:
        assert client.spec == policy.spec


def test_the_chunk_is_that_of_vla_run(policy, case, tmp_path):
    chunk = policy.act(images=frames(case), state=case.state, text=case.text, seed=5)
    assert np.asarray(chunk).tobytes() == ran(case, tmp_path, "--seed", "5").tobytes()


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
    with ChunkLoop(policy, rate_hz=50, replan_every=3, mode=mode, blend="ensemble", on_late="hold") as loop:
        loop.begin(observation)
        actions = []
        for _ in range(30):
            actions.append(loop.step(observation))
            loop.pace()
    assert all(a.values.shape == (7,) and np.isfinite(a.values).all() for a in actions)
    assert loop.stats["chunks"] >= 3 and loop.last_error is None
    assert {a.chunk.bundle for a in actions if not a.held} == {policy.spec.bundle}

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""vla::control::Client and its loop at a real server, at one that misbehaves, and at one that goes away in motion."""

import json
import os
import re
import signal
import subprocess
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from faulty_server import chunk, response
from golden_cases import Golden
from server_process import ROOT, SECONDS, Server, frames

import vla_cpp
from vla_cpp import wire

TOOL = os.environ.get("VLA_CONTROL_TOOL", "")
pytestmark = pytest.mark.skipif(not TOOL, reason="VLA_CONTROL_TOOL names no control_tool")


def in_cpp(kind, folder, address, images, states, text, **fields):
    """What control_tool answers to one scenario."""
    sent, absent = [], []
    for i, (view, image) in enumerate(images.items()):
        if image is None:
            absent.append(view)
            continue
        (folder / f"{i}.rgb").write_bytes(image.tobytes())
        sent.append({"view": view, "width": image.shape[1], "height": image.shape[0], "file": str(folder / f"{i}.rgb")})
    scenario = {"kind": kind, "address": address, "timeout": SECONDS, "frames": sent, "absent": absent, "states": states, "text": text}
    line = json.dumps({**scenario, **fields}) + "\n"
    done = subprocess.run([TOOL], input=line, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def states_of(case):
    return case.state if isinstance(case.state, dict) else {"state": case.state}


def bits(values):
    return np.asarray(values, np.float32).ravel().view(np.uint32).tolist()


def test_a_chunk_is_that_of_python(server, case, tmp_path):
    found = in_cpp("client", tmp_path, server.address, frames(case), states_of(case), case.text, seeds=[1, 2, 2**63 + 5])
    with vla_cpp.Client(server.address, timeout=SECONDS) as client:
        for seed, answer in zip((1, 2, 2**63 + 5), found["answers"]):
            chunk = client.act(images=frames(case), state=case.state, text=case.text, seed=seed)
            assert answer == {"rows": bits(chunk.actions), "notes": 0, "note": ""}
        assert found["names"] == [name for name in client.spec.action_names if name] and found["horizon"] == client.spec.horizon


def test_a_file_is_sent_as_it_is(server, case, tmp_path):
    files = {view: file.read_bytes() for view, file in case.images.items() if file}
    sent = [{"view": view, "width": 0, "height": 0, "file": str(case.images[view])} for view in files]
    absent = [view for view, file in case.images.items() if file is None]
    found = in_cpp("client", tmp_path, server.address, {}, states_of(case), case.text, seeds=[3], frames=sent, absent=absent)
    with vla_cpp.Client(server.address, timeout=SECONDS) as client:
        images = {**files, **dict.fromkeys(absent)}
        assert found["answers"][0]["rows"] == bits(client.act(images=images, state=case.state, text=case.text, seed=3).actions)


@pytest.mark.parametrize(
    "change, code, words",
    [
        (dict(states={}), "bad_observation", "state"),
        (dict(states={"nothing": [0.0]}), "bad_observation", "nothing"),
        (dict(frames=[{"view": "camera1", "width": 9, "height": 9, "file": os.devnull}], absent=[]), "bad_observation", "camera"),
    ],
)
def test_what_the_server_refuses_is_told(server, case, tmp_path, change, code, words):
    change = {"states": states_of(case), **change}
    found = in_cpp("client", tmp_path, server.address, frames(case), text=case.text, seeds=[1], **change)
    answer = found["answers"][0]
    assert answer["code"] == code and words in answer["message"]


@pytest.mark.parametrize("address, code", [("nowhere", "usage"), ("tcp://127.0.0.1:1", "timeout")])
def test_an_address_without_a_server(tmp_path, address, code):
    assert in_cpp("client", tmp_path, address, {}, {}, "", seeds=[1], timeout=0.3)["code"] == code


# --- a server that misbehaves -----------------------------------------------------------------------------------------------------

NAN = float("nan")
BAD = {
    "NaN": (lambda r: [response(r, chunk=chunk(NAN))], "bad_action", "finite"),
    "infinity": (lambda r: [response(r, chunk=chunk(float("inf")))], "bad_action", "finite"),
    "beyond any encoder": (lambda r: [response(r, chunk=chunk(1e12))], "bad_action", "within"),
    "too few rows": (lambda r: [response(r, chunk=chunk(1, horizon=3))], "incompatible", "shape"),
    "other rows than it says": (lambda r: [response(r, chunk=chunk(1, horizon=8, d_action=1))], "incompatible", "shape"),
    "another seed": (lambda r: [response(r, chunk=chunk(1, seed=r.act.seed + 1))], "incompatible", "seed"),
    "another kind": (lambda r: [response(r, health=wire.MESSAGES["HealthReply"](ready=True))], "incompatible", "another kind"),
    "another version": (lambda r: [wire.Response(protocol_version=2, request_id=r.request_id, chunk=chunk(1))], "incompatible", "version"),
    "no message": (lambda r: [b"\xff\xff\xff"], "incompatible", "other bytes"),
    "nothing": (lambda r: [], "timeout", "0.5 s"),
    "an error": (lambda r: [response(r, error=wire.MESSAGES["Error"](code=14, where="queue", found="full\x1b[2J"))], "busy", r"full\x1b[2J"),
    "an error for all": (lambda r: [wire.Response(protocol_version=1, error=wire.MESSAGES["Error"](code=11, where="x", found="y"))], "bad_request", "y"),
}


@pytest.mark.parametrize("what", BAD)
def test_a_bad_answer_is_told_and_the_next_is_taken(faulty, tmp_path, what):
    answer, code, words = BAD[what]
    faulty.on_act = lambda request: answer(request) if request.act.seed == 7 else [response(request, chunk=chunk(request.act.seed))]
    image = {"observation.images.top": np.zeros((4, 4, 3), np.uint8)}
    found = in_cpp("client", tmp_path, faulty.address, image, {"observation.state": [0.0, 0.0]}, "go", seeds=[5, 7, 9], timeout=0.5)
    first, second, third = found["answers"]
    assert first["rows"] == bits([5.0] * 8) and third["rows"] == bits([9.0] * 8)
    assert second["code"] == code and words in second["message"]


def test_another_policy_at_the_same_address_is_refused(faulty, tmp_path):
    def on_act(request):
        other = chunk(1)
        other.bundle.checksum = "xxh3:2"
        return [response(request, chunk=other)]

    faulty.on_act = on_act
    found = in_cpp("client", tmp_path, faulty.address, {}, {}, "go", seeds=[1], timeout=0.5)
    assert found["answers"][0]["code"] == "incompatible" and "make a new Client" in found["answers"][0]["message"]


def test_a_far_action_is_a_note(faulty, tmp_path):
    faulty.on_act = lambda request: [response(request, chunk=chunk(2e6))]
    (answer,) = in_cpp("client", tmp_path, faulty.address, {}, {}, "go", seeds=[1], timeout=5)["answers"]
    assert answer["notes"] == 1 and "2e+06" in answer["note"]


# --- in motion ------------------------------------------------------------------------------------------------------------------

LIMITS = {
    "format": "vla-limits 1",
    "columns": {name: {"kind": "position", "unit": "", "range": [-2, 2], "velocity": 2, "acceleration": 20} for name in ("a", "b")},
    "refuse_above": 1.0,
}


def test_a_server_that_goes_away_in_motion(faulty, tmp_path):
    """For a second nothing is answered, then all is again: commands stay within the limits, also where a chunk ends or comes late."""
    begun = time.monotonic()

    def on_act(request):
        seconds = time.monotonic() - begun
        return [] if 1 < seconds < 2 else [response(request, chunk=chunk(float(np.sin(3 * seconds))))]

    faulty.on_act = on_act
    rate = 50.0
    found = in_cpp(
        "drive", tmp_path, faulty.address, {}, {}, "go", rate_hz=rate, replan_every=2, seconds=3.0, timeout=0.2, limits=LIMITS, start=[0, 0]
    )  # fmt: skip
    states = np.array(found["states"])
    assert set(states) == {0, 1}  # commands and held ones, nothing else
    assert (states[-20:] == 0).any() and found["failed"] > 1 and found["chunks"] > 10
    commands = np.array(found["commands"], np.uint32).view(np.float32).reshape(len(states), 2).astype(float)
    velocity = np.diff(commands, axis=0) * rate
    assert np.abs(velocity).max() < 2 * 1.001 and np.abs(np.diff(velocity, axis=0)).max() * rate < 20 * 1.01
    assert np.ptp(commands) > 0.5
    assert found["allocations"] == 0


def test_a_loop_tells_a_server_that_lists_it_who_drives_and_what_it_counts(faulty, tmp_path):
    given = dict(rate_hz=20.0, replan_every=1, seconds=0.5, timeout=5)
    in_cpp("drive", tmp_path, faulty.address, {}, {}, "go", **given)
    assert faulty.acts and not any(request.act.HasField("loop") for request in faulty.acts)
    faulty.acts.clear()
    faulty.on_hello = lambda request: [response(request, hello=wire.MESSAGES["HelloReply"](min_version=1, max_version=1, features=["loop"]))]
    in_cpp("drive", tmp_path, faulty.address, {}, {}, "go", **given)
    told = [request.act.loop for request in faulty.acts]
    assert told[0].actions == 0 and told[-1].actions + told[-1].missed > 5 and all(state.driver == 1 for state in told)


def test_a_loop_outlives_its_server(tmp_path):
    """The process is killed, and another one takes its address."""
    case = Golden("two_views")
    server = Server(case)
    address = server.address
    restarted = []

    def restart():
        time.sleep(1.0)
        server.stop(signal.SIGKILL)
        time.sleep(0.5)
        restarted.append(Server(case, address=address))

    thread = threading.Thread(target=restart)
    thread.start()
    try:
        found = in_cpp("drive", tmp_path, address, frames(case), states_of(case), case.text, rate_hz=20.0, replan_every=1, seconds=6.0, timeout=2.0)
    finally:
        thread.join()
        assert restarted and re.match("tcp", restarted[0].address) and restarted[0].stop() == 0
    states = np.array(found["states"])
    assert set(states) <= {0, 1} and (states == 1).any() and states[-1] == 0


def test_the_example_of_a_controller_moves_within_its_limits(faulty, tmp_path):
    build = Path(TOOL).parents[1]
    command = ["c++", "-std=c++20", "-Wall", "-Wextra", "-pedantic", "-Werror", f"-I{ROOT}/include", ROOT / "examples/cpp/controller.cpp"]
    subprocess.run([*command, f"-L{build}/lib", "-lvla-control", f"-Wl,-rpath,{build}/lib", "-o", tmp_path / "controller"], check=True)
    faulty.on_act = lambda request: [response(request, chunk=chunk(0.5))]
    (tmp_path / "limits.json").write_text(json.dumps(LIMITS))
    arguments = [faulty.address, tmp_path / "limits.json", "go", "1.5", "top="]
    told = subprocess.run([tmp_path / "controller", *arguments], capture_output=True, text=True, timeout=SECONDS)
    assert told.returncode == 0, told.stderr
    lines = told.stdout.splitlines()
    assert len(lines) == 3 and re.search(r"1\.5 s  (policy|held  )  command +0\.5000", lines[-1])
    other = json.dumps(LIMITS).replace('"b"', '"c"')
    (tmp_path / "limits.json").write_text(other)
    refused = subprocess.run([tmp_path / "controller", *arguments], capture_output=True, text=True, timeout=SECONDS)
    assert refused.returncode == 1 and "expected the actions of double.gguf: a, b, found without b" in refused.stderr


def test_the_loop_of_a_simulator_gets_its_chunks_as_late_as_it_says(faulty, tmp_path):
    """A scripted simulator of two joints: 0.1 s are five periods of 50 Hz, in which the robot waits or holds."""
    build = Path(TOOL).parents[1]
    command = ["c++", "-std=c++20", "-Wall", "-Wextra", "-pedantic", "-Werror", f"-I{ROOT}/include", ROOT / "examples/cpp/simulated.cpp"]
    subprocess.run([*command, f"-L{build}/lib", "-lvla-control", f"-Wl,-rpath,{build}/lib", "-o", tmp_path / "simulated"], check=True)
    faulty.on_act = lambda request: [response(request, chunk=chunk(0.25))]
    faulty.description.n_action_steps = 2
    arguments = [tmp_path / "simulated", faulty.address, "observation.images.top", "observation.state", "go"]
    for mode, expected in (("sync", (0.15, "command")), ("async", (0.05, "none"))):
        process = subprocess.Popen([*arguments, mode, "0.1"], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        process.stdin.write(b"step 0.05 1 2\n")
        process.stdin.flush()
        assert process.stdout.readline() == b"look\n"
        process.stdin.write(b"2 1\n" + bytes(6))
        process.stdin.flush()
        seconds, state, *values = process.stdout.readline().split()
        assert (float(seconds), state.decode()) == expected and list(map(float, values)) == [0.25] * (2 * (mode == "sync"))
        assert list(faulty.acts[-1].act.states[0].values) == [1, 2] and process.poll() is None
        process.stdin.close()
        assert process.wait(SECONDS) == 0
        process.stdout.close()
    for given, sent, told in (
        (["rtc", "0.1"], "", "expected sync or async, found rtc"),
        (["sync", "soon"], "", "latency: expected seconds, found soon"),
        (["sync", "0"], "step 0 1 nan", "state: expected numbers, found step 0 1 nan"),
        (["sync", "0"], "step 0 1 2\n4 4\nabc", "frame: expected 48 bytes, found 3"),
        (["sync", "0"], "step 0 1 2\n4 99999\nabc", "frame: expected WIDTH HEIGHT, of at most 8192, found 4 99999"),
    ):
        refused = subprocess.run([*arguments, *given], input=sent, capture_output=True, text=True, timeout=SECONDS)
        assert refused.returncode == 1 and told in refused.stderr, refused.stderr

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""examples/fleet/app.py with Ray: robots keep their engine, engines die, come and go, and SIGTERM loses nobody's act.

Runs where examples/fleet/requirements.txt is installed: python -m pytest tests/client/fleet_ray_test.py
"""

import asyncio
import contextlib
import json
import re
import signal
import subprocess
import sys
import threading
import time
import urllib.request

import pytest

pytest.importorskip("ray", reason="Ray is not installed: examples/fleet/requirements.txt")
pytest.importorskip("websockets")

from server_process import ROOT, SECONDS  # noqa: E402
from websockets.exceptions import ConnectionClosed  # noqa: E402
from websockets.sync.client import connect  # noqa: E402

sys.path.append(str(ROOT / "examples/fleet"))

from app import Engines  # noqa: E402
from front import Lost  # noqa: E402
from load import cases_of  # noqa: E402
from ray.exceptions import ActorDiedError, RayTaskError  # noqa: E402
from ray.serve.exceptions import BackPressureError, DeploymentUnavailableError  # noqa: E402

from vla_cpp import openpi  # noqa: E402

FLEET, BUNDLE = ROOT / "examples/fleet", str(ROOT / "models/metaworld-tiny.gguf")
START = 120  # seconds for Ray to start and to load the engines
SCALE = 90  # for Serve to see a queue, or its end, and to act on it


@contextlib.contextmanager
def fleet(*options):
    """The address of an application that runs, and its process."""
    command = [sys.executable, FLEET / "app.py", BUNDLE, "--address", "127.0.0.1:0", *options]
    process = subprocess.Popen(list(map(str, command)), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    problems = []
    reader = threading.Thread(target=lambda: problems.append(process.stderr.read()))
    reader.start()
    late = threading.Timer(START, process.kill)
    late.start()
    try:
        line = process.stdout.readline()
        late.cancel()
        if not line.startswith("ready "):
            process.kill()
            reader.join()
            raise AssertionError(problems)
        yield re.search(r"ws://[\d.:]+", line)[0], process
    finally:
        late.cancel()
        process.terminate()
        process.wait(START)
        reader.join()
        process.stdout.close(), process.stderr.close()


@pytest.fixture(scope="module")
def two():
    with fleet("--replicas", 2) as (address, _):
        yield address


@pytest.fixture(scope="module")
def cases():
    return cases_of(BUNDLE, 1, None, 3)


class Handle:
    """Of a deployment whose calls end as told, one after the other."""

    def __init__(self, *ends):
        self._ends = list(ends)

    def options(self, session_id, method_name):
        assert (session_id, method_name) == ("arm", "act")
        return self

    async def remote(self, message):
        end = self._ends.pop(0)
        if isinstance(end, Exception):
            raise end
        return message + end


@pytest.mark.parametrize(
    "ends, answer",
    [
        ([b" done"], b"act done"),
        ([ActorDiedError(), b" again"], b"act again"),
        ([BackPressureError(1, 1)], "busy: the queue: expected room, found none"),
        ([RayTaskError("act", "its traceback", ValueError("seven"))], "internal: arm: ValueError('seven')"),
    ],
)
def test_an_act_whose_replica_died_is_asked_for_again(ends, answer):
    assert asyncio.run(Engines(Handle(*ends)).act("arm", b"act")) == answer


@pytest.mark.parametrize("end", [ActorDiedError(), DeploymentUnavailableError(None)])
def test_an_act_that_two_replicas_could_not_answer_is_lost(end):
    with pytest.raises(Lost, match=type(end).__name__):
        asyncio.run(Engines(Handle(end, end, b"never")).act("arm", b"act"))


@pytest.mark.parametrize("place, words", [("0.0.0.0:8000", "--insecure lets everybody in"), ("8000", "expected ADDRESS:PORT, found 8000")])
def test_an_address_that_other_machines_reach_has_to_be_meant(place, words):
    command = [sys.executable, FLEET / "app.py", BUNDLE, "--address", place]
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, timeout=START)
    assert done.returncode == 2 and words in done.stderr


class Arm:
    def __init__(self, address, name, cases):
        self._cases, self._n = cases, 0
        self.socket = connect(f"{address}/{name}", compression=None, proxy=None).__enter__()
        self.greeting = openpi.unpack(self.socket.recv(SECONDS), address)

    def ask(self):
        """The replica that answered, with the right chunk."""
        observation, expected = self._cases[self._n % len(self._cases)]
        message = {**observation["images"], **observation["state"], "prompt": observation["text"], "vla": {"seed": observation["seed"]}}
        self.socket.send(openpi.pack(message))
        answer = openpi.unpack(self.socket.recv(SECONDS), "fleet")
        assert answer["actions"].tobytes() == expected
        self._n += 1
        return answer["replica"]


def test_a_robot_keeps_its_engine_and_robots_are_spread(two, cases):
    asked = {}
    for name in (f"arm-{i}" for i in range(12)):
        replicas = set()
        for _ in range(2):  # the same after it connects again
            arm = Arm(two, name, cases)
            replicas |= {arm.greeting["replica"], arm.ask(), arm.ask()}
            arm.socket.close()
        assert len(replicas) == 1
        asked[name] = replicas.pop()
    assert len(set(asked.values())) == 2


def test_what_is_refused_is_refused_by_its_engine_as_openpi_does(two, cases):
    arm = Arm(two, "arm", cases)
    arm.socket.send(openpi.pack({"prompt": "go"}))
    assert arm.socket.recv(SECONDS).startswith("bad_observation: message: expected the keys")
    with pytest.raises(ConnectionClosed):
        arm.socket.recv(SECONDS)


def test_a_killed_replica_loses_no_act_but_those_under_way_and_the_rate_is_back_in_ten_seconds(two):
    command = [sys.executable, FLEET / "load.py", two, BUNDLE, "--robots", 4, "--rate", 3, "--seconds", 25, "--kill-after", 8]
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, timeout=START)
    told = json.loads(done.stdout)
    assert (told["wrong"], told["lost_beyond"]) == (0, 0), told
    assert told["lost"] <= told["under_way_at_kill"]
    assert told["full_rate_after_s"] is not None and told["full_rate_after_s"] < 10, told
    assert done.returncode == 0 and "killed " in done.stderr


def test_the_place_of_a_killed_replica_is_taken(two, cases):
    end, replicas = time.monotonic() + SCALE, set()
    while len(replicas) < 2:
        assert time.monotonic() < end
        replicas = {Arm(two, f"arm-{i}", cases).ask() for i in range(12)}


def test_engines_come_with_the_queue_and_go_with_it_and_robots_do_not_notice(cases):
    with fleet("--replicas", 1, "--most", 2, "--queue", 1, "--calm", 2) as (address, _):
        slow, stop, problems = Arm(address, "slow", cases), threading.Event(), []

        def hurry(name):
            try:
                arm = Arm(address, name, cases)
                while not stop.is_set():
                    arm.ask()
            except BaseException as problem:
                problems.append(problem)

        def seen():
            slow.ask()
            return {Arm(address, f"probe-{i}", cases).greeting["replica"] for i in range(12)}

        def until(count):
            end = time.monotonic() + SCALE
            while len(seen()) != count:
                assert time.monotonic() < end and not problems, problems
                time.sleep(0.5)

        assert len(seen()) == 1
        robots = [threading.Thread(target=hurry, args=(f"arm-{i}",)) for i in range(4)]
        [robot.start() for robot in robots]
        try:
            until(2)
        finally:
            stop.set()
            [robot.join() for robot in robots]
        until(1)
        assert not problems and slow.ask()


def test_on_sigterm_the_act_under_way_is_answered_and_robots_are_sent_away(cases):
    with fleet("--replicas", 1) as (address, process):
        with urllib.request.urlopen(address.replace("ws:", "http:") + "/readyz", timeout=SECONDS) as page:
            assert page.status == 200
        idle, busy, answers = Arm(address, "idle", cases), Arm(address, "busy", cases), []

        def act():
            while True:
                answers.append(busy.ask())

        def away(what):
            with pytest.raises(ConnectionClosed) as closed:
                what()
            assert (closed.value.rcvd.code, closed.value.rcvd.reason) == (1001, "the server drains; connect again")

        timer = threading.Timer(1.0, process.send_signal, [signal.SIGTERM])
        timer.start()
        away(act)
        timer.join()
        away(lambda: idle.socket.recv(SECONDS))
        assert answers and process.wait(START) == 0

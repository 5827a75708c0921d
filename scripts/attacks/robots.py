# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""A server, and who behaves there: robots of each protocol, a probe of its health, and a robot on a bad line."""

import importlib.util
import io
import json
import random
import re
import subprocess
import sys
import threading
import time
import urllib.request
from pathlib import Path

import hostile
import lerobot_calls
import lerobot_pickles
import numpy as np
import zmq
from drop_in import WebSocket, numpy_array, openpi_array, pack, unpack

import vla_cpp
from vla_cpp import wire

from .peers import act_of, request, scene, spec_of

MAX_MESSAGE_MIB, MAX_PIXELS = 32, 1 << 20
PERIOD = 0.03  # seconds between the acts of a robot that behaves
OTHER_PERIOD = 0.15  # of those that speak other protocols


def has_lerobot(options):
    """Whether the build speaks LeRobot's protocol."""
    command = [options.vla, "serve", options.bundle, "--lerobot", "here"]
    return "libgrpc++" not in subprocess.run(list(map(str, command)), capture_output=True, text=True).stderr


class Target:
    """A server of its own."""

    PLACES = ("address", "metrics", "openpi", "gr00t", "lerobot")

    def __init__(self, options):
        inspected = subprocess.run([options.vla, "inspect", options.bundle, "--json"], check=True, capture_output=True)
        keys = json.loads(inspected.stdout)["keys"]
        command = [options.vla, "serve", options.bundle, "--bind", "tcp://127.0.0.1:0", "--metrics", "127.0.0.1:0"]
        command += ["--openpi", "127.0.0.1:0", "--gr00t", "127.0.0.1:0"]
        for kind in ("view", "state"):
            for i, name in enumerate(keys[f"observation.{kind}s"]):
                command += ["--map", f"{kind}{i}={name}"]
        command += ["--threads", options.threads, "--max-message", MAX_MESSAGE_MIB, "--max-pixels", MAX_PIXELS]
        if has_lerobot(options):
            command += ["--lerobot", "127.0.0.1:0"]
        command = list(map(str, command))
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        line = self.process.stdout.readline()
        addresses = re.search(r"address='?([^\s']+)", line)[1].split(",")
        self.address, openpi, gr00t, *lerobot = addresses
        self.lerobot = lerobot[0].replace("grpc://", "tcp://") if lerobot else ""
        self.openpi, self.gr00t = openpi.replace("ws://", "tcp://"), gr00t.removeprefix("gr00t+")
        self.metrics = "http://" + re.search(r"metrics='?([^\s']+)", line)[1]

    def memory_mib(self, what="VmRSS"):
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        return int(re.search(rf"{what}:\s+(\d+)", status)[1]) / 1024


class Behaved:
    """Robots that ask for an act in each of their periods, one in each protocol, and a probe of health, over ZeroMQ and
    HTTP."""

    def __init__(self, target):
        self._target = target
        self._robot, self._probe = (vla_cpp.Client(target.address, timeout=20) for _ in range(2))
        spec = self._robot.spec
        images, states = scene(spec, 1)
        self._observation = {"images": images, "state": states, "text": "open the drawer"}
        self._expected = self._robot.act(**self._observation, seed=1).actions.tobytes()
        self._openpi = WebSocket(target.openpi.removeprefix("tcp://"))
        self._openpi.receive()
        self._gr00t = zmq.Context.instance().socket(zmq.REQ)
        self._gr00t.linger, self._gr00t.rcvtimeo = 0, 20_000
        self._gr00t.connect(target.gr00t)
        self._messages = pack(openpi_act(spec, 1), openpi_array), pack(gr00t_act(spec, 1), numpy_array)
        self._lerobot = None
        if target.lerobot and importlib.util.find_spec("grpc"):
            self._lerobot, n = lerobot_calls.Robot(target.lerobot.removeprefix("tcp://")), spec.states[0].width
            cameras = {name.removeprefix("observation.images."): frame for name, frame in images.items()}
            motors = {f"motor{i}": 0.1 for i in range(n)}
            self._lerobot.begin(lerobot_pickles.setup_of(motors, cameras))
            seen = {**motors, **cameras, "task": "open the drawer"}
            self._pickle = lerobot_pickles.dumps(lerobot_pickles.TimedObservation(0.0, 0, seen, True))

    def watch(self, seconds):
        """Milliseconds of acts, of health, of /healthz, and then how long after its deadline LATE came."""
        self._until = time.monotonic() + seconds
        what = [
            ("act", self._act, PERIOD),
            ("openpi", self._act_openpi, OTHER_PERIOD), ("gr00t", self._act_gr00t, OTHER_PERIOD),
            ("health", self._probe.health, 0.02), ("healthz", self._healthz, 0.02),
        ]  # fmt: skip
        what += [("lerobot", self._act_lerobot, OTHER_PERIOD)] if self._lerobot else []
        times = {"late": [], **{name: [] for name, *_ in what}}
        threads = [threading.Thread(target=self._repeat, args=(times[name], act, period)) for name, act, period in what]
        self._failed = []
        [thread.start() for thread in threads]
        [thread.join() for thread in threads]
        if self._failed:
            raise self._failed[0]
        while time.monotonic() < self._until + seconds / 4:
            times["late"] += late_after(self._target.address, self._robot.spec, self._observation)
        return times

    def _repeat(self, times, what, period):
        """At uneven times: robots whose periods were in step would meet at the engine always, or never."""
        draw = random.Random(period)
        try:
            while time.monotonic() < self._until:
                start = time.perf_counter()
                what()
                took = time.perf_counter() - start
                times.append(1e3 * took)
                time.sleep(max(0, period * draw.uniform(0.5, 1.5) - took))
        except Exception as failure:
            self._failed.append(failure)

    def _act(self):
        chunk = self._robot.act(**self._observation, seed=1)
        assert chunk.actions.tobytes() == self._expected, "the actions of another observation"

    def _act_openpi(self):
        actions = self._openpi.ask(self._messages[0])["actions"]
        assert actions.tobytes() == self._expected, "the actions of another observation"

    def _act_gr00t(self):
        self._gr00t.send(self._messages[1])
        answer = unpack(self._gr00t.recv())
        assert isinstance(answer, list) and len(answer) == 2, answer

    def _act_lerobot(self):
        self._lerobot.observe(self._pickle)
        assert self._lerobot.actions()

    def _healthz(self):
        with urllib.request.urlopen(self._target.metrics + "/healthz", timeout=20) as page:
            assert page.status == 200


def late_after(address, spec, observation, n=8, deadline_ms=2):
    """Several connections of a third peer ask at once, and cannot all be served before the deadline: milliseconds after
    it at which those that are late were told so."""
    sockets = []
    with zmq.Context() as context:
        for i in range(n):
            s = context.socket(zmq.DEALER)
            s.linger, s.rcvtimeo = 0, 20_000
            s.connect(address.replace("tcp://", "tcp://127.0.0.3:0;"))
            s.send(request("health"))
            sockets.append(s)
        [s.recv() for s in sockets]
        message = wire.Request(protocol_version=1, request_id=2)
        limits = wire.MESSAGES["Limits"]()
        data = wire.act_bytes(message, spec, limits, **observation, seed=1, noise=None, deadline_ms=deadline_ms)
        sent, poller, late = {}, zmq.Poller(), []
        for s in sockets:
            sent[s] = time.perf_counter()
            s.send(data)
            poller.register(s, zmq.POLLIN)
        while sent:
            came = poller.poll(20_000)
            assert came, "an act was not answered"
            for s, _ in came:
                answer = wire.Response.FromString(s.recv())
                if answer.error.code == 16:
                    late.append(1e3 * (time.perf_counter() - sent[s]) - deadline_ms)
                poller.unregister(s)
                del sent[s]
        [s.close() for s in sockets]
    return late


def slow_upload(target, seconds, outcome):
    """A robot on a bad line: its act takes that long to come, and is answered."""
    spec = spec_of(target)
    data = act_of(spec, rgb=np.zeros((spec.views[0].height, spec.views[0].width, 3), np.uint8))
    try:
        with hostile.connect(target.address, hostile.HANDSHAKE, source="127.0.0.4") as raw:
            data = hostile.long_frame(len(data), data)
            for piece in np.array_split(np.frombuffer(data, np.uint8), 50):
                raw.sendall(piece.tobytes())
                time.sleep(seconds / 50)
            raw.settimeout(20)
            came = io.BytesIO()
            while b"\x08\x01\x10\x07\x2a" not in came.getvalue():  # version 1, number 7, a chunk
                part = raw.recv(1 << 16)
                assert part, "the connection was closed"
                came.write(part)
        outcome.append(True)
    except (OSError, AssertionError) as failure:
        print(f"slow upload: {failure!r}", file=sys.stderr)


def openpi_act(spec, seed):
    """An observation of openpi's protocol, with the names that Target gives it."""
    images, states = scene(spec, seed)
    parts = {f"view{i}": frame for i, frame in enumerate(images.values())}
    parts.update((f"state{i}", values) for i, values in enumerate(states.values()))
    return {**parts, "prompt": "open the drawer", "vla": {"seed": 1}}


def gr00t_act(spec, seed):
    images, states = scene(spec, seed)
    short = lambda name: name.rsplit(".", 1)[-1]  # noqa: E731
    parts = {f"video.{short(name)}": frame[None, None] for name, frame in images.items()}
    parts.update((f"state.{short(name)}", values[None, None]) for name, values in states.items())
    parts["annotation.human.task_description"] = ["open the drawer"]
    return {"endpoint": "get_action", "data": {"observation": parts, "options": {"seed": 1}}}

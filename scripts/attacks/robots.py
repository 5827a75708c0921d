# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""A server, and who behaves there: robots of each protocol, a probe of its health, and a robot on a bad line."""

import contextlib
import importlib.util
import io
import json
import random
import re
import shlex
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from pathlib import Path
from urllib.parse import urlsplit

import hostile
import lerobot_calls
import lerobot_pickles
import numpy as np
import zmq
from drop_in import WebSocket, numpy_array, openpi_array, pack, unpack

import vla_cpp
from vla_cpp import wire

from .lerobot import children_of
from .peers import act_of, request, scene, spec_of

MAX_MESSAGE_MIB, MAX_PIXELS = 32, 1 << 20
PERIOD = 0.03  # seconds between the acts of a robot that behaves
OTHER_PERIOD = 0.15  # of those that speak other protocols


class Target:
    """A server of its own. doors: "page" for one with the live page, "control" for one with a socket for orders, which do not go together.
    more: options of it."""

    PLACES = ("address", "metrics", "openpi", "gr00t", "lerobot", "page", "control", "pid")

    def __init__(self, options, doors=(), more=()):
        inspected = subprocess.run([options.vla, "inspect", options.bundle, "--json"], check=True, capture_output=True)
        keys = json.loads(inspected.stdout)["keys"]
        command = [options.vla, "serve", options.bundle, "--bind", "tcp://127.0.0.1:0", "--metrics", "127.0.0.1:0"]
        command += ["--openpi", "127.0.0.1:0", "--gr00t", "127.0.0.1:0"]
        for kind in ("view", "state"):
            for i, name in enumerate(keys[f"observation.{kind}s"]):
                command += ["--map", f"{kind}{i}={name}"]
        command += ["--threads", options.threads, "--max-message", MAX_MESSAGE_MIB, "--max-pixels", MAX_PIXELS]
        command += ["--lerobot", "127.0.0.1:0"]
        self._folder = tempfile.TemporaryDirectory()
        self.control = f"{self._folder.name}/control" if "control" in doors else ""
        command += ["--control", self.control] if self.control else []
        command += ["--page", "127.0.0.1:0"] if "page" in doors else []
        command += more
        command = list(map(str, command))
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        self.pid = str(self.process.pid)
        told = dict(word.partition("=")[::2] for word in shlex.split(self.process.stdout.readline()))
        self.address, openpi, gr00t, lerobot = told["address"].split(",")
        self.lerobot = lerobot.replace("grpc://", "tcp://")
        self.openpi, self.gr00t = openpi.replace("ws://", "tcp://"), gr00t.removeprefix("gr00t+")
        self.metrics, self.page = "http://" + told["metrics"].removeprefix("http://"), told.get("page", "")

    def processes(self):
        """The server's, and those that it started."""
        return [self.process.pid, *children_of(self.process.pid)]

    def memory_mib(self, what="VmRSS"):
        sizes = []
        for pid in self.processes():
            with contextlib.suppress(OSError, TypeError):  # it may have ended
                sizes.append(int(re.search(rf"{what}:\s+(\d+)", Path(f"/proc/{pid}/status").read_text())[1]))
        return sum(sizes) / 1024

    def end(self, patience=30):
        """Seconds from SIGTERM to its end, and its exit status."""
        start = time.monotonic()
        self.process.terminate()
        try:
            status = self.process.wait(patience)
        except subprocess.TimeoutExpired:
            self.process.kill()
            status = self.process.wait()
        self.process.stdout.close()
        self._folder.cleanup()
        return time.monotonic() - start, status


class Peak:
    """The most memory that a server and its processes have had, from here to `stop`."""

    def __init__(self, target):
        self._target, self._most, self._over = target, 0.0, threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self):
        while not self._over.wait(0.2):
            self._most = max(self._most, self._target.memory_mib("VmHWM"))

    def stop(self):
        self._over.set()
        self._thread.join()
        return max(self._most, self._target.memory_mib("VmHWM"))


class Behaved:
    """Robots that ask for an act in each of their periods, one in each protocol, and probes of health, over ZeroMQ and HTTP, of the page
    and of orders.

    lost    acts that were not answered, by robot
    breaks  how often that began
    back    the longest time from such an act to the next answer, in seconds, by robot

    patience: seconds, after which an act is lost; pace: how many times as long as PERIOD and OTHER_PERIOD their periods are; scale: sides of their frames over those of the views.
    """

    def __init__(self, target, patience=5.0, pace=1, scale=1):
        self._target, self._patience, self._pace = target, patience, pace
        self._robot, self._probe = (vla_cpp.Client(target.address, timeout=self._patience) for _ in range(2))
        spec = self._robot.spec
        images, states = scene(spec, 1, scale)
        self._observation = {"images": images, "state": states, "text": "open the drawer"}
        self._expected = self._robot.act(**self._observation, seed=1).actions.tobytes()
        self._openpi = self._gr00t = None
        self._messages = pack(openpi_act(spec, 1, scale), openpi_array), pack(gr00t_act(spec, 1, scale), numpy_array)
        self._lerobot = None
        if importlib.util.find_spec("grpc"):
            self._lerobot = lerobot_calls.Robot(target.lerobot.removeprefix("tcp://"), self._patience)
            cameras = {name.removeprefix("observation.images."): frame for name, frame in images.items()}
            motors = dict.fromkeys(spec.states[0].names, 0.1)
            self._setup = lerobot_pickles.setup_of(motors, cameras)
            self._lerobot.begin(self._setup)
            seen = {**motors, **cameras, "task": "open the drawer"}
            self._pickle = lerobot_pickles.dumps(lerobot_pickles.TimedObservation(0.0, 0, seen, True))
        self.lost, self.breaks, self.back = {}, {}, {}

    def watch(self, seconds, is_late=True):
        """Milliseconds of acts and of what is probed, and then, where `is_late`, how long after its deadline LATE came."""
        self._until = time.monotonic() + seconds
        what = [
            ("act", self._act, PERIOD * self._pace),
            ("openpi", self._act_openpi, OTHER_PERIOD * self._pace), ("gr00t", self._act_gr00t, OTHER_PERIOD * self._pace),
            ("health", self._probe.health, 0.02), ("healthz", self._healthz, 0.02),
        ]  # fmt: skip
        what += [("lerobot", self._act_lerobot, OTHER_PERIOD * self._pace)] if self._lerobot else []
        what += [("page", self._look, 0.2)] if self._target.page else []
        what += [("order", self._order, 0.2)] if self._target.control else []
        times = {"late": [], **{name: [] for name, *_ in what}}
        self.lost, self.breaks, self.back = dict.fromkeys(times, 0), dict.fromkeys(times, 0), dict.fromkeys(times, 0.0)
        threads = [threading.Thread(target=self._repeat, args=(name, times[name], act, period)) for name, act, period in what]
        self._failed = []
        [thread.start() for thread in threads]
        [thread.join() for thread in threads]
        if self._failed:
            raise self._failed[0]
        while is_late and time.monotonic() < self._until + seconds / 4 and self._target.process.poll() is None:
            times["late"] += late_after(self._target.address, self._robot.spec, self._observation)
        return times

    def _repeat(self, name, times, what, period):
        """At uneven times: robots whose periods were in step would meet at the engine always, or never."""
        draw, lost_at = random.Random(name), None
        while time.monotonic() < self._until:
            start = time.perf_counter()
            try:
                what()
            except AssertionError as failure:  # a wrong answer is worse than none
                self._failed.append(failure)
                return
            except Exception as failure:
                print(f"{name}: {failure!r:.300}", file=sys.stderr)
                self.lost[name] += 1
                self.breaks[name] += not lost_at
                lost_at = lost_at or start
                time.sleep(period)
                continue
            if lost_at:
                self.back[name], lost_at = max(self.back[name], time.perf_counter() - lost_at), None
            took = time.perf_counter() - start
            times.append(1e3 * took)
            time.sleep(max(0, period * draw.uniform(0.5, 1.5) - took))
        if lost_at:
            self.back[name] = max(self.back[name], time.perf_counter() - lost_at)

    def _act(self):
        chunk = self._robot.act(**self._observation, seed=1)
        assert chunk.actions.tobytes() == self._expected, "the actions of another observation"

    def _act_openpi(self):
        robot, self._openpi = self._openpi, None  # connected anew where this fails
        if robot is None:
            robot = WebSocket(self._target.openpi.removeprefix("tcp://"))
            robot.socket.settimeout(self._patience)
            if robot.receive() is None:
                raise ConnectionError("no greeting")
        robot.send(self._messages[0])
        opcode, answer = robot.receive() or (8, b"")
        if opcode != 2:
            raise ConnectionError(answer)
        assert unpack(answer)["actions"].tobytes() == self._expected, "the actions of another observation"
        self._openpi = robot

    def _act_gr00t(self):
        robot, self._gr00t = self._gr00t, None
        if robot is None:
            robot = zmq.Context.instance().socket(zmq.REQ)
            robot.linger, robot.rcvtimeo = 0, int(1000 * self._patience)
            robot.connect(self._target.gr00t)
        robot.send(self._messages[1])
        answer = unpack(robot.recv())
        assert isinstance(answer, list) and len(answer) == 2, answer
        self._gr00t = robot

    def _act_lerobot(self):
        import grpc

        try:
            self._lerobot.observe(self._pickle)
            if not self._lerobot.actions():
                raise ConnectionError("no actions")
        except grpc.RpcError as failure:
            if failure.code() is grpc.StatusCode.FAILED_PRECONDITION:  # a new connection: it says what it is
                self._lerobot.begin(self._setup)
            raise

    def _healthz(self):
        with urllib.request.urlopen(self._target.metrics + "/healthz", timeout=self._patience) as page:
            assert page.status == 200

    def _look(self):
        """As a browser that shows the page, which asks for the acts since the last one."""
        parts = urlsplit(self._target.page)
        with urllib.request.urlopen(f"http://{parts.netloc}/acts?{parts.query}&after=0", timeout=self._patience) as page:
            assert json.loads(page.read())["last"] > 0

    def _order(self):
        with socket.socket(socket.AF_UNIX) as raw:
            raw.settimeout(self._patience)
            raw.connect(self._target.control)
            raw.sendall(b'{"do": "list"}\n')
            assert b"metaworld" in raw.recv(1 << 16)


def late_after(address, spec, observation, n=8, deadline_ms=2):
    """Several connections of a third peer ask at once, and cannot all be served before the deadline: milliseconds after
    it at which those that are late were told so."""
    sockets = []
    with zmq.Context() as context:
        for i in range(n):
            s = context.socket(zmq.DEALER)
            s.linger = 0
            s.connect(address.replace("tcp://", "tcp://127.0.0.3:0;"))
            s.send(request("health"))
            sockets.append(s)
        if not all(s.poll(20_000) and s.recv() for s in sockets):
            [s.close() for s in sockets]
            return []
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
            if not came:
                break
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


def openpi_act(spec, seed, scale=1):
    """An observation of openpi's protocol, with the names that Target gives it."""
    images, states = scene(spec, seed, scale)
    parts = {f"view{i}": frame for i, frame in enumerate(images.values())}
    parts.update((f"state{i}", values) for i, values in enumerate(states.values()))
    return {**parts, "prompt": "open the drawer", "vla": {"seed": 1}}


def gr00t_act(spec, seed, scale=1):
    images, states = scene(spec, seed, scale)
    short = lambda name: name.rsplit(".", 1)[-1]  # noqa: E731
    parts = {f"video.{short(name)}": frame[None, None] for name, frame in images.items()}
    parts.update((f"state.{short(name)}", values[None, None]) for name, values in states.items())
    parts["annotation.human.task_description"] = ["open the drawer"]
    return {"endpoint": "get_action", "data": {"observation": parts, "options": {"seed": 1}}}

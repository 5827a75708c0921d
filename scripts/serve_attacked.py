#!/usr/bin/env python3
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What a client that behaves gets from `vla serve` while other peers attack it, as rows of a Markdown table.

scripts/serve_attacked.py                 the shipped policy, 20 seconds quiet and 20 under every attack at once
scripts/serve_attacked.py --attack half_sent --attack flood
scripts/serve_attacked.py --real-time    on a machine that does other work beside it

The attackers come from 127.0.0.2 (`own_address` from the robot's 127.0.0.1, `many_addresses` from 256 others) and run at the lowest priority, since they are to attack the server and not the cores that it
shares with them here. Fails where an answer is lost or wrong, or a row misses its bar. docs/security.md says what is promised.
"""

import argparse
import contextlib
import importlib.util
import io
import itertools
import json
import os
import re
import socket
import struct
import subprocess
import sys
import threading
import time
import urllib.request
import zlib
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import zmq

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "python"), str(ROOT / "tests/client")]
import hostile  # noqa: E402
import hostile_images  # noqa: E402
import http2  # noqa: E402
import lerobot_calls  # noqa: E402
import lerobot_pickles  # noqa: E402
from drop_in import WebSocket, numpy_array, openpi_array, pack, unpack  # noqa: E402

import vla_cpp  # noqa: E402
from vla_cpp import wire  # noqa: E402

ATTACKER = "127.0.0.2"
MAX_MESSAGE_MIB, MAX_PIXELS = 32, 1 << 20
HEALTH_MS, LATE_MS, ACT_RATIO = 20, 20, 2  # the bars
PERIOD = 0.03  # seconds between the acts of a robot that behaves
HALF_SENT = hostile.HANDSHAKE + hostile.long_frame(30_000_000)
OTHER_PERIOD = 0.15  # of those that speak other protocols


# --- attacks: each runs in a process of its own until that is ended --------------------------------------------------


def again_and_again(*steps):
    """Each step in a thread of its own, begun again when the server has ended its connection."""

    def repeat(step):
        while True:
            with contextlib.suppress(OSError):
                step()

    for step in steps:
        threading.Thread(target=repeat, args=(step,), daemon=True).start()
    threading.Event().wait()


def connect(target, data=b""):
    return hostile.connect(target.address, data, source=ATTACKER)


def half_sent(target, begin=HALF_SENT):
    """40 requests of 30 MB, of which 20 MB come, as fast as a network of 1 Gbit brings them."""

    def one():
        with connect(target, begin) as raw:
            for _ in range(20):
                raw.sendall(bytes(1_000_000))
                time.sleep(0.3)
            while raw.recv(1 << 16):
                pass

    again_and_again(*[one] * 40)


def flood(target):
    """Messages of a million frames, and of requests without end whose answers nobody reads."""
    health = request("health")

    def frames():
        with connect(target, hostile.HANDSHAKE) as raw:
            raw.sendall(b"\x01\x00" * 1_000_000)

    def unread():
        with connect(target, hostile.HANDSHAKE) as raw:
            while True:
                raw.sendall((bytes([0, len(health)]) + health) * 100)

    again_and_again(frames, frames, unread, unread)


def connections(target):
    """200 connections that say nothing, or half a greeting."""
    again_and_again(*[lambda: silent(target, b"")] * 100, *[lambda: silent(target, hostile.GREETING[:40])] * 100)


def drip(target):
    """20 peers that send requests byte by byte."""
    health = request("health")

    def one():
        with connect(target, hostile.HANDSHAKE) as raw:
            while True:
                for byte in bytes([0, len(health)]) + health:
                    raw.sendall(bytes([byte]))
                    time.sleep(0.005)

    again_and_again(*[one] * 20)


def silent(target, data):
    """A connection that has sent that much, and waits for its end."""
    with connect(target, data) as raw:
        while raw.recv(1 << 16):
            pass


def send(target, begin, steps, pause=0.0):
    """A connection that sends one step after the other, and reads nothing."""
    with connect(target, begin) as raw:
        for step in steps:
            raw.sendall(step)
            time.sleep(pause)


def gr00t(target):
    """What the attacks on the native protocol do, at that of GR00T, and msgpack that is deep, wide or long."""
    target = argparse.Namespace(address=target.gr00t)
    ping = b"\x81\xa8endpoint\xa4ping"
    wide = b"\x81\xa4data" + b"\xdf\x00\x0f\xff\xff" * 1000
    bodies = [hostile.long_frame(len(b), b, flags=2) for b in (b"\x91" * 100_000, b"\xdd" + b"\xff" * 4, wide, bytes(1_000_000))]
    threading.Thread(target=half_sent, args=(target,), daemon=True).start()
    again_and_again(
        *[lambda: silent(target, hostile.GREETING[:40])] * 60,
        lambda: send(target, hostile.HANDSHAKE, [b"\x01\x00" * 1_000_000]),
        lambda: send(target, hostile.HANDSHAKE, itertools.repeat(bytes([0, len(ping)]) + ping)),
        lambda: send(target, hostile.HANDSHAKE, itertools.cycle(bodies), pause=0.05),
    )


def openpi(target):
    """The same at that of openpi: handshakes in drops, fragments, pings and acts without end, peers that read nothing."""
    head, frame = hostile.UPGRADE, hostile.websocket_frame
    with vla_cpp.Client(target.address, timeout=20) as client:
        act = frame(0x82, pack(openpi_act(client.spec, 2), openpi_array))
    target = argparse.Namespace(address=target.openpi)
    begin = head + frame(0x82, bytes(30_000_000))[:14]
    threading.Thread(target=half_sent, args=(target, begin), daemon=True).start()
    again_and_again(
        *[lambda: silent(target, b"")] * 50,
        *[lambda: silent(target, head[:60])] * 50,
        *[lambda: silent(target, head)] * 50,
        *[lambda: send(target, b"", (head[i : i + 1] for i in range(len(head))), pause=0.01)] * 10,
        lambda: send(target, head + frame(0x02, b""), itertools.repeat(frame(0x00, b"") * 1000)),
        lambda: send(target, head, itertools.repeat(frame(0x89, b"?" * 100) * 100)),
        lambda: send(target, head, itertools.repeat(act, 20), pause=0.05),
        lambda: send(target, head, [frame(0x82, b"\x91" * 100_000)]),
        lambda: send(target, head, [frame(0x82, bytes(1_000_000))]),
    )


def lerobot(target):
    """The same at that of LeRobot, in HTTP/2: streams that are begun and reset, pieces that stay half, pickles that are deep or would execute."""
    with contextlib.suppress(ImportError):
        import grpc
    begin = http2.PREFACE + http2.frame(http2.SETTINGS, 0, 0)
    call = http2.frame(http2.HEADERS, http2.END_HEADERS, 1, http2.headers("/transport.AsyncInference/SendObservations"))
    bodies = [b"\x80\x04" + b"(" * 100_000, b"\x80\x04" + b"]q\x00" * 30_000, bytes(1_000_000), b"\x80\x04\x8c\x02os\x8c\x06system\x93."]
    target = argparse.Namespace(address=target.lerobot)

    def pickles():
        with lerobot_calls.Robot(target.address.removeprefix("tcp://")) as robot:
            for body in itertools.cycle(bodies):
                with contextlib.suppress(grpc.RpcError):
                    robot.begin(body)
                time.sleep(0.05)

    def half():
        with lerobot_calls.Robot(target.address.removeprefix("tcp://")) as robot, contextlib.suppress(grpc.RpcError):
            robot._observe(lerobot_calls.halves(10))

    resets = b"".join(
        http2.frame(http2.HEADERS, http2.END_HEADERS, n, http2.headers("/transport.AsyncInference/GetActions"))
        + http2.frame(http2.RST_STREAM, 0, n, bytes(4))
        for n in range(1, 401, 2)
    )
    again_and_again(
        *([half] * 20 + [pickles] * 2 if importlib.util.find_spec("grpc") else []),
        *[lambda: silent(target, b"")] * 50,
        *[lambda: silent(target, http2.PREFACE[:10])] * 50,
        *[lambda: silent(target, begin + call)] * 50,
        lambda: send(target, begin, itertools.repeat(http2.frame(http2.PING, 0, 0, bytes(8)) * 100)),
        lambda: send(target, begin, itertools.repeat(http2.frame(http2.SETTINGS, 0, 0) * 100)),
        lambda: send(target, begin, [resets], pause=0.05),
    )


def drip_http(target):
    """60 HTTP requests that come a byte at a time, and take the page a byte at a time."""
    host = urlsplit(target.metrics)

    def one():
        raw = socket.create_connection((host.hostname, host.port), timeout=20, source_address=(ATTACKER, 0))
        with raw:
            for byte in b"GET /metrics HTTP/1.1\r\nHost: robot\r\nX-Long: " + b"x" * 1000:
                raw.sendall(bytes([byte]))
                time.sleep(0.01)

    again_and_again(*[one] * 60)


def hostile_png(target):
    """Acts with an image with 200 compressed texts that would be 8 MB each, and with one with fewer rows than it announces."""
    ask_for_ever(target, [act_of(spec_of(target), png=image) for image in (png(8, 8, texts=200), png(4000, 4000, rows=1))])


def heavy_images(target):
    """Acts with the images that cost most of those that the limit on pixels admits."""
    spec, black = spec_of(target), np.zeros((1024, 1024, 3), np.uint8)
    images = [act_of(spec, jpeg=hostile_images._scans(1024, 1024, 15)), act_of(spec, png=hostile_images._encoded(black, "PNG"))]
    ask_for_ever(target, images)


def own_address(target):
    """Acts that are in order, from a program of the robot's own machine."""
    spec = spec_of(target)
    ask_for_ever(target, [act_of(spec, rgb=np.zeros((v.height, v.width, 3), np.uint8)) for v in spec.views[:1]], source="127.0.0.1")


def many_addresses(target):
    """256 connections from as many addresses, whose handshakes are done, and that say nothing more."""

    def one(source):
        with hostile.connect(target.address, hostile.HANDSHAKE, source=source) as raw:
            while raw.recv(1 << 16):
                pass

    again_and_again(*[lambda n=n: one(f"127.0.{1 + n // 128}.{1 + n % 128}") for n in range(256)])


def spec_of(target):
    """What the policy takes; a new connection may have to give way to the attacks that began before."""
    while True:
        with contextlib.suppress(vla_cpp.Disconnected), vla_cpp.Client(target.address, timeout=20) as client:
            return client.spec


def act_of(spec, **image):
    """The bytes of an act that has this image in each of its views."""
    message = wire.Request(protocol_version=1, request_id=7)
    for v in spec.views:
        view = message.act.views.add(name=v.name, **{k: data for k, data in image.items() if k != "rgb"})
        if "rgb" in image:
            view.rgb.height, view.rgb.width, view.rgb.rows = *image["rgb"].shape[:2], image["rgb"].tobytes()
    for s in spec.states:
        message.act.states.add(name=s.name).values.extend([0.1] * s.width)
    message.act.text = "go"
    return message.SerializeToString()


def ask_for_ever(target, acts, n_connection=70, source=ATTACKER):
    """Connections of one peer that ask again as soon as they are answered."""
    poller = zmq.Poller()
    for n in range(n_connection):
        s = zmq.Context.instance().socket(zmq.DEALER)
        s.linger = 0
        s.connect(target.address.replace("tcp://", f"tcp://{source}:0;"))
        s.send(acts[n % len(acts)])
        poller.register(s, zmq.POLLIN)
    for n in itertools.count():
        for s, _ in poller.poll():
            s.recv()
            s.send(acts[n % len(acts)])


ATTACKS = {
    f.__name__: f
    for f in (
        half_sent, flood, connections, drip, gr00t, openpi, lerobot, drip_http, hostile_png, heavy_images, own_address, many_addresses,
    )
}  # fmt: skip


def request(kind):
    message = wire.Request(protocol_version=1, request_id=1)
    getattr(message, kind).SetInParent()
    return message.SerializeToString()


def scene(spec, seed):
    """Frames by view and vectors by state."""
    rng = np.random.default_rng(seed)
    images = {v.name: rng.integers(0, 255, (v.height, v.width, 3), np.uint8) for v in spec.views}
    return images, {s.name: np.full(s.width, 0.1, np.float32) for s in spec.states}


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


def png(width, height, rows=None, texts=0):
    def chunk(name, data):
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    text = b"Comment\0\0" + zlib.compress(bytes(8_000_000))
    pixels = zlib.compress(bytes((3 * width + 1) * (height if rows is None else rows)))
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"zTXt", text) * texts + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


# --- who behaves -------------------------------------------------------------------------------------------------------


def has_lerobot(options):
    """Whether the build speaks LeRobot's protocol."""
    command = [options.vla, "serve", options.bundle, "--lerobot", "here"]
    return "libgrpc++" not in subprocess.run(list(map(str, command)), capture_output=True, text=True).stderr


class Target:
    """A server of its own, or where it is."""

    def __init__(self, options):
        inspected = subprocess.run([options.vla, "inspect", options.bundle, "--json"], check=True, capture_output=True)
        keys = json.loads(inspected.stdout)["keys"]
        command = [options.vla, "serve", options.bundle, "--bind", "tcp://127.0.0.1:0", "--metrics", "127.0.0.1:0"]
        command += ["--openpi", "127.0.0.1:0", "--gr00t", "127.0.0.1:0"]
        for kind in ("view", "state"):
            for i, name in enumerate(keys[f"observation.{kind}s"]):
                command += ["--map", f"{kind}{i}={name}"]
        command += ["--threads", str(options.threads), "--max-message", str(MAX_MESSAGE_MIB), "--max-pixels", str(MAX_PIXELS)]
        if has_lerobot(options):
            command += ["--lerobot", "127.0.0.1:0"]
        self.process = subprocess.Popen(list(map(str, command)), stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
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
    """Robots that ask for an act in each of their periods, one in each protocol, and a probe of health, over ZeroMQ and HTTP."""

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
            ("act", self._act, PERIOD), ("openpi", self._act_openpi, OTHER_PERIOD), ("gr00t", self._act_gr00t, OTHER_PERIOD),
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
        try:
            while time.monotonic() < self._until:
                start = time.perf_counter()
                what()
                took = time.perf_counter() - start
                times.append(1e3 * took)
                time.sleep(max(0, period - took))
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
    """Several connections of a third peer ask at once, and cannot all be served before the deadline: milliseconds after it at
    which those that are late were told so."""
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


# --- the table ---------------------------------------------------------------------------------------------------------


def p(values, percent):
    return float(np.percentile(values, percent)) if values else float("nan")


def last_of_all():
    os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    os.nice(19)


def measure(options):
    if options.real_time:  # the server inherits it
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    target = Target(options)
    attackers = []
    try:
        behaved = Behaved(target)
        behaved.watch(1)  # warm
        quiet = behaved.watch(options.seconds)
        before = target.memory_mib()
        names = [name for name in options.attack or ATTACKS if target.lerobot or name != "lerobot"]
        for name in names:
            where = [target.address, target.metrics, target.openpi, target.gr00t, target.lerobot]
            command = [sys.executable, __file__, "--as", name, *where]
            attackers.append(subprocess.Popen(command, stdout=subprocess.PIPE))
        [attacker.stdout.readline() for attacker in attackers]
        time.sleep(1)
        uploaded = []
        upload = threading.Thread(target=slow_upload, args=(target, options.seconds * 0.8, uploaded))
        upload.start()
        attacked = behaved.watch(options.seconds)
        upload.join()
        ended = [name for name, a in zip(names, attackers) if a.poll() is not None]
        grown = target.memory_mib("VmHWM") - before
    finally:
        [a.kill() for a in attackers]
        [a.wait() for a in attackers]
        target.process.terminate()
    status = target.process.wait(20)
    return quiet, attacked, dict(grown_mib=grown, uploaded=bool(uploaded), ended=ended, status=status)


def rows_of(options, quiet, attacked, rest):
    """(what, measured when quiet, under attack, bar, whether it holds)"""
    loose = options.loose
    memory = 24 * MAX_MESSAGE_MIB + 15 * 16 + 10  # docs/security.md
    rows = []
    for name, q in itertools.product([n for n in ("act", "openpi", "gr00t", "lerobot") if n in quiet], (50, 95)):
        before, after = p(quiet[name], q), p(attacked[name], q)
        what = name if name == "act" else f"act by {name}"
        rows.append((f"{what} p{q}, ms", f"{before:.1f}", f"{after:.1f} ({after / before:.2f}x)",
                     f"{ACT_RATIO * loose:g}x", after <= ACT_RATIO * loose * before))  # fmt: skip
    for name, bar in (("health", HEALTH_MS), ("healthz", HEALTH_MS), ("late", LATE_MS)):
        worst = p(attacked[name], 95)
        what = "LATE after its deadline" if name == "late" else name
        rows.append((f"{what} p95 (largest), ms", f"{p(quiet[name], 95):.1f} ({max(quiet[name], default=0):.1f})",
                     f"{worst:.1f} ({max(attacked[name], default=0):.1f})", f"{bar * loose:g}", worst <= bar * loose))  # fmt: skip
    rows += [
        ("memory beyond the policy, MiB", "", f"{rest['grown_mib']:.0f}", f"{memory}", rest["grown_mib"] <= memory),
        ("a slow upload is answered", "", str(rest["uploaded"]), "True", rest["uploaded"]),
        ("attacks that gave up", "", ", ".join(rest["ended"]) or "none", "none", not rest["ended"]),
        ("exit status", "", str(rest["status"]), "0", rest["status"] == 0),
    ]
    return rows


def parse():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bundle", type=Path, default=ROOT / "models/metaworld-tiny.gguf")
    parser.add_argument("--vla", type=Path, default=Path(os.environ.get("VLA_BINARY", ROOT / "build/cpu/bin/vla")))
    parser.add_argument("--threads", type=int, default=1, help="of the engine; default: 1")
    parser.add_argument("--seconds", type=float, default=20, help="of each measurement; default: 20")
    parser.add_argument("--attack", action="append", choices=ATTACKS, help="default: all at once")
    parser.add_argument("--loose", type=float, default=1, help="factor on the bars of time, for a machine with other work")
    parser.add_argument(
        "--real-time", action="store_true", help="server and robot have their cores before all other work of the machine; takes root"
    )
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--as", dest="role", nargs=6, help=argparse.SUPPRESS)  # attack, then Target's addresses
    return parser.parse_args()


def main():
    options = parse()
    if options.role:
        attack, *addresses = options.role
        print("attacking", flush=True)
        last_of_all()  # what is imported before that is not part of the attack
        return ATTACKS[attack](argparse.Namespace(**dict(zip(("address", "metrics", "openpi", "gr00t", "lerobot"), addresses))))
    quiet, attacked, rest = measure(options)
    rows = rows_of(options, quiet, attacked, rest)
    if options.json:
        print(json.dumps({"quiet": quiet, "attacked": attacked, **rest}))
    else:
        print("| | quiet | under attack | bar |\n| --- | --- | --- | --- |")
        for what, before, under, bar, holds in rows:
            print(f"| {what} | {before} | {under} | {bar}{'' if holds else ' **missed**'} |")
        counts = ", ".join(f"{len(attacked[name])} {name}" for name in attacked)
        print(f"\nUnder attack: {counts}.")
    return 0 if all(row[-1] for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())

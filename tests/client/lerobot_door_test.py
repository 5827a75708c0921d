# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The process of `vla serve --lerobot`: floods of HTTP/2 at it, its death, and robots that lose their connection."""

import contextlib
import os
import signal
import struct
import subprocess
import time
import urllib.request
from pathlib import Path

import numpy as np
import pytest

grpc = pytest.importorskip("grpc")

import hostile  # noqa: E402
import http2  # noqa: E402
import server_process  # noqa: E402
from http2 import END_HEADERS, PREFACE, frame, headers  # noqa: E402
from lerobot_calls import Peer, Robot  # noqa: E402
from lerobot_pickles import TimedObservation, dumps, setup_of  # noqa: E402
from server_process import SECONDS, VLA, frames  # noqa: E402

OTHER = "127.0.0.2"  # an address that is not the robots'
DOOR = "vla-door-lerobot"
CALL = "/transport.AsyncInference/GetActions"
CONTINUATION, PRIORITY = 9, 2


class Scene:
    def __init__(self, case):
        self.views = {view.removeprefix("observation.images."): f for view, f in frames(case).items() if f is not None}
        self.motors = {f"joint_{i}": float(x) for i, x in enumerate(case.state)}
        self.text = case.text

    def setup(self, motors=None):
        return dumps(setup_of(motors or self.motors, self.views))

    def observation(self):
        return dumps(TimedObservation(0.0, 0, {**self.motors, **self.views, "task": self.text}, True))


@pytest.fixture(scope="module")
def scene(case):
    return Scene(case)


def doors(server):
    """The process ids of the front end's processes of a server."""
    found = []
    for status in Path("/proc").glob("[0-9]*/status"):
        with contextlib.suppress(OSError):
            text = status.read_text()
            if f"Name:\t{DOOR[:15]}\n" in text and f"\nPPid:\t{server}\n" in text and "State:\tZ" not in text:
                found.append(int(status.parent.name))
    return found


def until(condition, seconds=SECONDS):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if value := condition():
            return value
        time.sleep(0.02)
    raise AssertionError("it did not come to that")


def refusal(robot, scene):
    """How a robot's observation or its act is refused; None where it gets its actions."""
    try:
        robot.observe(scene.observation())
        assert robot.actions()
    except grpc.RpcError as error:
        return f"{error.code().name} {error.details()}"


def settled(door, scene):
    """A robot that was served, and whose connection has ended."""
    with Robot(door) as robot:
        robot.begin(scene.setup())
        assert refusal(robot, scene) is None


def pairs():
    """Calls that are begun and reset."""
    stream = 1
    while True:
        yield frame(http2.HEADERS, END_HEADERS, stream, headers(CALL)) + frame(http2.RST_STREAM, 0, stream, bytes(4))
        stream += 2


def again(data):
    while True:
        yield data


FLOODS = {
    "rapid reset": pairs,
    "continuation": lambda: again(frame(CONTINUATION, 0, 1, b"\x00\x01a\x01b" * 100)),
    "empty continuation": lambda: again(frame(CONTINUATION, 0, 1)),
    "ping": lambda: again(frame(http2.PING, 0, 0, bytes(8))),
    "settings": lambda: again(frame(http2.SETTINGS, 0, 0, struct.pack(">HI", 4, 65535))),
    "empty data": lambda: again(frame(http2.DATA, 0, 1)),
    "window update": lambda: again(frame(http2.WINDOW_UPDATE, 0, 0, struct.pack(">I", 1))),
    "priority": lambda: again(frame(PRIORITY, 0, 1, bytes(5))),
    "unknown": lambda: again(frame(0xBB, 0, 0, bytes(8))),
}
FIRST = {
    "continuation": frame(http2.HEADERS, 0, 1, headers(CALL)),
    "empty continuation": frame(http2.HEADERS, 0, 1, headers(CALL)),
    "empty data": frame(http2.HEADERS, END_HEADERS, 1, headers(CALL)),
    "priority": frame(http2.HEADERS, END_HEADERS, 1, headers(CALL)),
}


def flood(address, name, source=OTHER, seconds=10):
    """Floods until the server ends the connection. The frames that it took."""
    n, end = 0, time.monotonic() + seconds
    with contextlib.closing(hostile.connect(address, source=source)) as raw:
        raw.settimeout(seconds)
        try:
            raw.sendall(PREFACE + frame(http2.SETTINGS, 0, 0) + FIRST.get(name, b""))
            for each in FLOODS[name]():
                raw.sendall(each)
                n += 1
                assert time.monotonic() < end, f"{name}: {n} frames and no end"
        except OSError:
            return n


@contextlib.contextmanager
def serving(case, *options):
    """The process id of a server, and the address of its front end."""
    server = server_process.Server(case, "--lerobot", "127.0.0.1:0", *options)
    try:
        yield server, next(a for a in server.told["address"].split(",") if a.startswith("grpc://"))
    finally:
        if server.process.poll() is None:
            start = time.monotonic()
            assert server.stop() == 0
            assert time.monotonic() - start < 3


@pytest.fixture(scope="module")
def served(case):
    with serving(case, "--max-message", "2", "--connections", "64") as both:
        yield both


@pytest.mark.alone
@pytest.mark.parametrize("name", FLOODS)
def test_a_flood_ends_its_connection_and_nothing_else(served, scene, name):
    with Robot(served[1]) as robot:
        robot.begin(scene.setup())
        for _ in range(3):
            flood(served[1], name)
            assert refusal(robot, scene) is None


def test_a_peer_that_does_not_read_ends_alone(served, scene):
    with contextlib.closing(hostile.connect(served[1], source=OTHER)) as raw:
        raw.settimeout(30)
        with pytest.raises(OSError):
            raw.sendall(PREFACE + frame(http2.SETTINGS, 0, 0))
            while True:
                raw.sendall(frame(http2.PING, 0, 0, bytes(8)))
                time.sleep(0.01)
    settled(served[1], scene)


def test_a_connection_without_a_call_ends(served):
    with contextlib.closing(hostile.connect(served[1], source=OTHER)) as raw:
        raw.settimeout(SECONDS)
        raw.sendall(PREFACE + frame(http2.SETTINGS, 0, 0))
        start = time.monotonic()
        while raw.recv(4096):
            pass
        assert 9 < time.monotonic() - start


@pytest.mark.alone
def test_three_hundred_short_connections_of_another_address_cost_a_robot_nothing(served, scene):
    """Half of them with a set-up: the robot's connection stays, and what it is."""
    door = served[1]
    with Robot(door) as robot:
        robot.begin(scene.setup())
        assert refusal(robot, scene) is None
        for i in range(300):
            with Peer(door, OTHER) as other:
                other.setup(scene.setup()) if i % 2 else other.ask("Ready", b"")
        assert refusal(robot, scene) is None
    time.sleep(0.2)
    with Robot(door) as robot:
        assert refusal(robot, scene) is None


def test_two_robots_of_an_address_that_reconnect_get_no_others_joints(case, scene):
    with serving(case) as (_, door):
        turned = scene.setup(dict(reversed(scene.motors.items())))
        with Robot(door) as first, Robot(door) as second:
            first.begin(scene.setup())
            second.begin(turned)
            assert refusal(first, scene) is None and refusal(second, scene) is None
        time.sleep(0.2)
        with Robot(door) as robot:
            words = refusal(robot, scene)
            assert words.startswith("FAILED_PRECONDITION") and "start the robot's client again" in words
            robot.begin(turned)
            assert refusal(robot, scene) is None


def test_a_monitor_without_a_setup_costs_a_robot_nothing(case, scene):
    with serving(case) as (_, door), Robot(door) as monitor:
        with pytest.raises(grpc.RpcError):
            monitor.actions()
        settled(door, scene)
        time.sleep(0.2)
        with Robot(door) as robot:
            assert refusal(robot, scene) is None


@pytest.mark.alone
@pytest.mark.parametrize("how, seconds", [(signal.SIGKILL, 2), (signal.SIGSEGV, 2), (signal.SIGSTOP, 4)])
def test_a_process_that_ends_or_stops_is_started_again_and_native_robots_notice_nothing(case, scene, how, seconds):
    with serving(case, "--metrics", "127.0.0.1:0") as (server, door):
        native = server_process.Robot(server.address, case)
        with native, Robot(door) as robot:
            robot.begin(scene.setup())
            assert refusal(robot, scene) is None
            (pid,) = doors(server.process.pid)
            os.kill(pid, how)
            start = time.monotonic()
            until(lambda: refusal(robot, scene) is None, 10)  # it says nothing of what it is
            assert time.monotonic() - start < seconds
            native.acts(20)
            assert doors(server.process.pid) not in ([pid], [])
        page = urllib.request.urlopen(f"http://{server.told['metrics']}/metrics").read().decode()
        assert 'vla_dropped_connections_total{why="door"} 1' in page


def test_the_process_has_limits_and_nothing_of_the_servers(served):
    (pid,) = doors(served[0].process.pid)
    status = Path(f"/proc/{pid}/status").read_text()
    assert "NoNewPrivs:\t1" in status
    names = [os.readlink(path) for path in Path(f"/proc/{pid}/fd").iterdir()]
    assert names and not [name for name in names if name.endswith(".gguf")], names
    if b"__asan_init" in VLA.read_bytes() or b"__tsan_init" in VLA.read_bytes():
        pytest.skip("a sanitizer instead of limits of memory and system calls")
    assert "Seccomp:\t2" in status
    limits = Path(f"/proc/{pid}/limits").read_text().splitlines()
    (data,) = [line.split() for line in limits if line.startswith("Max data size")]
    assert int(data[3]) < 1 << 30


def test_the_process_ends_with_its_server(case):
    with serving(case) as (server, _):
        (pid,) = doors(server.process.pid)
        server.process.kill()
        server.process.wait()
        until(lambda: not Path(f"/proc/{pid}").exists())


@pytest.mark.alone
def test_a_server_stops_in_its_usual_time_while_the_process_is_stopped(case):
    with serving(case) as (server, _):  # its end is timed
        os.kill(doors(server.process.pid)[0], signal.SIGSTOP)


def test_a_server_without_its_program_says_where_it_looked(case, tmp_path):
    alone = tmp_path / "vla"
    alone.write_bytes(VLA.read_bytes())
    alone.chmod(0o755)
    command = [alone, "serve", case.bundle, "--bind", "tcp://127.0.0.1:0", "--lerobot", "127.0.0.1:0"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode != 0 and str(tmp_path / DOOR) in done.stderr, done


def test_frames_in_half_precision_are_answered_and_of_other_types_refused_by_name(served, scene):
    with Robot(served[1]) as robot:
        robot.begin(scene.setup())
        views = {name: (view // 255).astype(np.float16) for name, view in scene.views.items()}
        robot.observe(TimedObservation(0.0, 0, {**scene.motors, **views, "task": "go"}, True))
        assert robot.actions()
        views = {name: view.astype(np.complex64) for name, view in scene.views.items()}
        with pytest.raises(grpc.RpcError) as raised:
            robot.observe(TimedObservation(0.0, 1, {**scene.motors, **views, "task": "go"}, True))
        words = raised.value.details()
        assert raised.value.code() == grpc.StatusCode.INVALID_ARGUMENT and "float32" in words and "<c8" in words

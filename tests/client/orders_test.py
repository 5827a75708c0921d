# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""An operator's orders beside robots: none stops a robot, whatever is ordered, in what order, and by whom."""

import contextlib
import json
import os
import re
import shlex
import signal
import socket
import struct
import subprocess
import threading
import time
from pathlib import Path

import gguf
import numpy as np
import pytest
from drop_in import WebSocket, npy_array, openpi_array, pack, serving
from golden_cases import Golden, data_offset, sealed
from gr00t_test import Client as Gr00tClient
from gr00t_test import nested
from server_process import SECONDS, VLA, frames

import vla_cpp

PICK, PLACE = Golden("two_views"), Golden("one_view")
DOORS = ["native", "openpi", "gr00t", "lerobot"]


def order(path, *words):
    return subprocess.run([VLA, "ctl", path, *map(str, words)], capture_output=True, text=True, timeout=60)


@pytest.fixture(scope="module")
def broken(tmp_path_factory):
    """The bundle of PICK with one weight that is not a number: nothing that comes after it is one."""
    path = tmp_path_factory.mktemp("broken") / "broken.gguf"
    sound, at = PICK.bundle.read_bytes(), data_offset(PICK.bundle, "lm.blk.1.attn_norm.weight")
    path.write_bytes(sealed(sound[:at] + struct.pack("<f", float("nan")) + sound[at + 4 :]))
    return path


@contextlib.contextmanager
def native(address):
    with vla_cpp.Client(address("tcp://"), timeout=SECONDS) as client:
        yield lambda: client.act(images=frames(PICK), state=PICK.state, text=PICK.text, seed=3).actions.tobytes()


@contextlib.contextmanager
def openpi(address):
    message = {**frames(PICK), "observation.state": np.array(PICK.state, np.float32), "prompt": PICK.text, "vla": {"seed": 3}}
    with WebSocket(address("ws://")) as client:
        client.receive()
        yield lambda: client.ask(pack(message, openpi_array))["actions"].tobytes()


@contextlib.contextmanager
def gr00t(address):
    client = Gr00tClient(address("gr00t+"), npy_array)
    asked = {"observation": nested(PICK), "options": {"seed": 3}}

    def act():
        actions, _ = client.ask("get_action", asked)
        return b"".join(np.asarray(values).tobytes() for values in actions.values())

    yield act
    client.socket.close()


@contextlib.contextmanager
def lerobot(address):
    pytest.importorskip("grpc")
    from lerobot_calls import Robot
    from lerobot_pickles import setup_of
    from lerobot_test import cameras, motors, observation

    with Robot(address("grpc://")) as robot:
        robot.begin(setup_of(motors(PICK), cameras(PICK)))
        steps = iter(range(1000))

        def act():
            robot.observe(observation(PICK, next(steps)))
            return len(robot.actions())  # of LeRobot a seed is not given

        yield act


def options_of(door):
    names = [f"{view}={view}" for view in frames(PICK)] + ["observation.state=observation.state"]
    mapped = [word for name in names for word in ("--map", name)] if door == "openpi" else []
    return [] if door == "native" else [f"--{door}", "127.0.0.1:0", *mapped]


@pytest.mark.parametrize("door", DOORS)
def test_robots_that_name_no_policy_keep_theirs_whatever_else_is_loaded(tmp_path, door):
    if door == "lerobot" and "libgrpc++" in subprocess.run([VLA, "serve", PICK.bundle, "--bind", "tcp://127.0.0.1:0", "--lerobot", "x"], capture_output=True, text=True).stderr:
        pytest.skip("a build without the door")
    control = tmp_path / "control"
    with serving(PICK, "--control", control, *options_of(door)) as (_, address):
        with globals()[door](address) as act:
            expected = act()
            assert expected
            assert order(control, "load", f"place={PLACE.bundle}").returncode == 0
            assert act() == expected
        with globals()[door](address) as act:  # and who comes later
            assert act() == expected
            refused = order(control, "unload", "bundle")
            assert refused.returncode == 2 and "not the default" in refused.stderr
            assert act() == expected
            assert order(control, "unload", "place").returncode == 0
            assert act() == expected


def test_a_policy_that_is_not_finite_is_refused_at_the_start_with_the_place(broken):
    answer = subprocess.run([VLA, "serve", broken, "--bind", "tcp://127.0.0.1:0"], capture_output=True, text=True, timeout=60)
    assert (answer.returncode, answer.stdout) == (5, "")
    assert answer.stderr.startswith(f"error: bad_action: {broken}: warm-up: expected finite actions, found numbers that are not, of the network first at the tap ")
    assert "lm.blk.1" in answer.stderr


def test_a_policy_that_is_not_finite_is_refused_when_it_is_loaded_and_swapped_while_robots_go_on(broken, tmp_path):
    control = tmp_path / "control"
    with serving(PICK, "--control", control) as (_, address), native(address) as act:
        expected = act()
        for name in ("bundle", "other"):
            answer = order(control, "load", f"{name}={broken}")
            assert answer.returncode == 5 and "first at the tap lm.blk.1" in answer.stderr, answer.stderr
            assert answer.stdout == "" and act() == expected
        listed = order(control, "list").stdout.splitlines()
        assert [line.split()[0] for line in listed] == ["bundle"]


def test_orders_in_the_wrong_order_are_refused_or_obeyed_and_robots_go_on(tmp_path):
    control = tmp_path / "control"
    with started("--control", control) as (process, address), native(lambda _: address) as act:
        expected, place = act(), f"place={PLACE.bundle}"
        for words, code in (
            (("unload", "bundle"), 2), (("unload", "place"), 4), (("load", place), 0), (("load", f"place={PICK.bundle}"), 12), (("load", place), 0),
            (("unload", "place"), 0), (("unload", "place"), 4), (("load", f"bundle={PLACE.bundle}"), 12), (("load", "a=hub:" + "a" * 60_000), 2),
            (("load", f"bundle={PICK.bundle}"), 0), (("load", place), 0), (("load", f"bundle={PICK.bundle}"), 0),
        ):  # fmt: skip
            answer = order(control, *words)
            assert answer.returncode == code, (words, answer.stderr[:300])
            assert act() == expected
        assert order(control, "drain").returncode == 0
        assert order(control, "load", place).returncode != 0
        assert process.wait(SECONDS) == 0


@contextlib.contextmanager
def started(*options):
    """A server, and the address of its own protocol."""
    command = [VLA, "serve", PICK.bundle, "--bind", "tcp://127.0.0.1:0", "--threads", "1", *map(str, options)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        try:
            told = dict(word.partition("=")[::2] for word in shlex.split(process.stdout.readline()))
            yield process, told["address"]
        finally:
            process.kill()


@contextlib.contextmanager
def dripping(path):
    """Clients that never end their order."""
    peers, done = [socket.socket(socket.AF_UNIX) for _ in range(6)], threading.Event()
    [peer.connect(str(path)) for peer in peers]

    def drip():
        while not done.wait(0.2):
            for peer in peers:
                with contextlib.suppress(OSError):
                    peer.send(b"{")

    thread = threading.Thread(target=drip)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()
        [peer.close() for peer in peers]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_clients_that_drip_their_order_keep_neither_orders_nor_the_end_waiting(tmp_path, number):
    control = tmp_path / "control"
    with started("--control", control) as (process, _), dripping(control):
        begun = time.monotonic()
        assert order(control, "list").returncode == 0
        assert order(control, "load", f"place={PLACE.bundle}").returncode == 0
        assert time.monotonic() - begun < 4
        begun = time.monotonic()
        process.send_signal(number)
        assert process.wait(SECONDS) == 0 and time.monotonic() - begun < 3
        assert not control.exists()


@pytest.fixture
def slow(tmp_path):
    """A bundle that takes seconds to be refused: with 16 GB of zeros, which take no place on the disk, behind what it had."""
    path = tmp_path / "slow.gguf"
    path.write_bytes(PICK.bundle.read_bytes())
    reader = gguf.GGUFReader(path, "r+")
    last = max(reader.tensors, key=lambda tensor: tensor.data_offset)
    dims = last.field.parts[3]
    row = int(last.n_bytes) // int(dims[-1])
    dims[-1] = (16 << 30) // row
    reader.data.flush()
    os.truncate(path, int(last.data_offset) + (16 << 30))
    return path


def test_a_bundle_that_is_being_loaded_does_not_hold_the_end_up(tmp_path, slow):
    control, trace = tmp_path / "control", tmp_path / "trace.json"
    with started("--control", control, "--trace", trace) as (process, address), native(lambda _: address) as act:
        assert act()
        with subprocess.Popen([VLA, "ctl", control, "load", f"slow={slow}"], stderr=subprocess.DEVNULL) as loading:
            time.sleep(1)
            assert loading.poll() is None
            begun = time.monotonic()
            process.terminate()
            assert process.wait(SECONDS) == 0 and time.monotonic() - begun < 3
            assert loading.wait(SECONDS) == 9
    assert not control.exists()
    assert any(event["name"] == "act" for event in json.loads(trace.read_text()))


def test_a_client_that_falls_silent_is_refused_after_its_time(tmp_path):
    control = tmp_path / "control"
    with started("--control", control), socket.socket(socket.AF_UNIX) as peer:
        peer.settimeout(SECONDS)
        peer.connect(str(control))
        peer.sendall(b'{"do": "li')
        begun = time.monotonic()
        assert b'"error"' in peer.recv(4096)
        assert 4 < time.monotonic() - begun < 8


def test_a_client_has_a_moment_for_its_order_however_many_others_connect(tmp_path):
    control = tmp_path / "control"
    with started("--control", control), contextlib.ExitStack() as peers:
        begun = time.monotonic()
        first, *_ = [connected(control, peers) for _ in range(40)]
        assert b'"error"' in first.recv(4096)  # since others came, long before its time is over
        assert 0.05 <= time.monotonic() - begun < 4


def test_a_client_that_does_not_wait_to_connect_gives_its_order_while_others_are_before_it(tmp_path):
    control = tmp_path / "control"
    with started("--control", control) as (process, _), contextlib.ExitStack() as peers:
        process.send_signal(signal.SIGSTOP)  # takes none, as while it loads a bundle
        last = [connected(control, peers) for _ in range(60)][-1]
        last.sendall(b'{"do": "list"}\n')
        process.send_signal(signal.SIGCONT)
        assert b'"policies"' in last.recv(4096)


def test_an_order_that_is_deep_takes_no_more_memory_than_its_bytes(tmp_path):
    control = tmp_path / "control"
    with started("--control", control) as (process, _):
        assert order(control, "list").returncode == 0
        before = peak_kib(process)
        for line in (b"[" * 60_000, b'{"do":' + b"[" * 30_000 + b"]" * 30_000 + b"}"):
            with contextlib.ExitStack() as peers:
                peer = connected(control, peers)
                peer.sendall(line + b"\n")
                assert b'"error"' in peer.recv(4096)
        assert peak_kib(process) < before + 2000


def connected(path, peers):
    """A client that asks the system for its connection once, as one with a timeout does."""
    peer = peers.enter_context(socket.socket(socket.AF_UNIX))
    peer.settimeout(SECONDS)
    peer.connect(str(path))
    return peer


def peak_kib(process):
    return int(re.search(r"VmHWM:\s+(\d+)", Path(f"/proc/{process.pid}/status").read_text())[1])


@pytest.mark.parametrize("ignored", [False, True])
def test_a_hangup_ends_a_server_as_sigterm_does_unless_it_was_started_to_outlive_it(ignored):
    command = ["nohup"] * ignored + [VLA, "serve", PICK.bundle, "--bind", "tcp://127.0.0.1:0", "--log", "json"]
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout.readline().startswith("ready ")
    process.send_signal(signal.SIGHUP)
    if ignored:
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(0.5)
        process.terminate()
    _, log = process.communicate(timeout=SECONDS)
    assert process.returncode == 0 and '"event":"shutdown"' in log


def test_doors_without_keys_beside_one_with_keys_are_told(tmp_path):
    for name in ("server", "arm"):
        subprocess.run([VLA, "keygen", tmp_path / name], check=True, capture_output=True)
    token = tmp_path / "token"
    token.write_text("secret")
    token.chmod(0o600)
    keys = ["--curve-secret", tmp_path / "server.secret", "--curve-clients", tmp_path / "arm.public"]

    def told(*options):
        command = [VLA, "serve", PICK.bundle, "--bind", "tcp://127.0.0.1:0", "--log", "json", *map(str, options)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
            assert process.stdout.readline().startswith("ready ")
            process.terminate()
            lines = [json.loads(line) for line in process.communicate(timeout=SECONDS)[1].splitlines()]
        return [(line["level"], line["option"], line["token"]) for line in lines if line["event"] == "without_keys"]

    assert told("--gr00t", "127.0.0.1:0") == told(*keys) == []
    assert told(*keys, "--gr00t", "127.0.0.1:0") == [("warn", "--gr00t", False)]
    assert told(*keys, "--gr00t", "127.0.0.1:0", *options_of("openpi"), "--api-token", token) == [("warn", "--openpi", True), ("warn", "--gr00t", True)]

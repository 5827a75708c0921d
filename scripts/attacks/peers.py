# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What attacks are made of: connections that are begun again and again, and requests."""

import contextlib
import struct
import threading
import time
import zlib

import hostile
import numpy as np

import vla_cpp
from vla_cpp import wire

ATTACKER = "127.0.0.2"  # where attacks come from; the robot's address is 127.0.0.1


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


def spec_of(target):
    """What the policy takes; a new connection may have to give way to the attacks that began before."""
    while True:
        with contextlib.suppress(vla_cpp.Disconnected), vla_cpp.Client(target.address, timeout=20) as client:
            return client.spec


def scene(spec, seed, scale=1):
    """Frames by view and vectors by state. scale: sides of the frames over those of the views."""
    rng = np.random.default_rng(seed)
    images = {v.name: rng.integers(0, 255, (scale * v.height, scale * v.width, 3), np.uint8) for v in spec.views}
    return images, {s.name: np.full(s.width, 0.1, np.float32) for s in spec.states}


def request(kind):
    message = wire.Request(protocol_version=1, request_id=1)
    getattr(message, kind).SetInParent()
    return message.SerializeToString()


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


def png(width, height, rows=None, texts=0):
    def chunk(name, data):
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    text = b"Comment\0\0" + zlib.compress(bytes(8_000_000))
    pixels = zlib.compress(bytes((3 * width + 1) * (height if rows is None else rows)))
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"zTXt", text) * texts + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Peers that break the rules of ZMTP (ZeroMQ RFC 23), byte by byte, over plain TCP."""

import random
import socket
import struct
from urllib.parse import urlsplit

SIGNATURE = b"\xff" + bytes(8) + b"\x7f"
GREETING = SIGNATURE + b"\x03\x00" + b"NULL".ljust(20, b"\0") + b"\0" + bytes(31)
READY = b"\x05READY" + b"\x0bSocket-Type" + struct.pack(">I", 6) + b"DEALER"
HANDSHAKE = GREETING + b"\x04" + bytes([len(READY)]) + READY
UPGRADE = (
    b"GET / HTTP/1.1\r\nHost: robot\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
)


def websocket_frame(first, payload, is_masked=True):
    """A client's frame of WebSocket, by a mask of zeros; `first`: final bit and opcode."""
    n = len(payload)
    size = bytes([n]) if n < 126 else b"\x7e" + struct.pack(">H", n) if n < 65536 else b"\x7f" + struct.pack(">Q", n)
    return bytes([first, 0x80 * is_masked | size[0]]) + size[1:] + bytes(4) * is_masked + payload


def long_frame(size, payload=b"", flags=2):
    """A frame that announces `size` bytes and brings what it brings."""
    return bytes([flags]) + struct.pack(">Q", size) + payload


# What a peer sends before it falls silent, by name.
HALF_SENT = {
    "nothing": b"",
    "half a signature": SIGNATURE[:5],
    "a signature": SIGNATURE,
    "half a greeting": GREETING[:40],
    "a greeting": GREETING,
    "half a READY": HANDSHAKE[:-10],
    "a size and nothing else": HANDSHAKE + long_frame(1000),
    "half a frame": HANDSHAKE + long_frame(1000, bytes(500)),
    "half of the largest message": HANDSHAKE + long_frame(1 << 20, bytes(1 << 19)),
    "a first frame of two": HANDSHAKE + b"\x01\x03abc",
}
GARBAGE = {
    "an HTTP request": b"GET / HTTP/1.1\r\nHost: robot\r\n\r\n",
    "TLS": b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(200),
    "zeros": bytes(10_000),
    "noise": random.Random(1).randbytes(10_000),
    "a greeting of version 1": b"\x01\x00",
    "a greeting of version 99": SIGNATURE + b"\x63" + GREETING[11:],
    "another mechanism": GREETING.replace(b"NULL", b"EVIL"),
    "a PUB peer": HANDSHAKE.replace(b"DEALER", b"PUBPUB"),
    "noise after the handshake": HANDSHAKE + random.Random(2).randbytes(10_000),
    "a frame of 2^63 bytes": HANDSHAKE + long_frame(1 << 63, bytes(100)),
    "a frame of 2^64 - 1 bytes": HANDSHAKE + long_frame((1 << 64) - 1, bytes(100)),
    "a frame over the limit": HANDSHAKE + long_frame((1 << 20) + 1, bytes(100)),
    "a huge command": HANDSHAKE + long_frame(1 << 40, bytes(100), flags=6),
    "reserved flags": HANDSHAKE + b"\xf8\x03abc",
    "a request that is none": HANDSHAKE + b"\x00\x03abc",
}


def connect(address, data=b"", source=""):
    """A TCP connection to `tcp://HOST:PORT` that has sent `data`, from an address of one's own."""
    where = urlsplit(address)
    raw = socket.create_connection((where.hostname, where.port), timeout=20, source_address=(source, 0))
    try:
        raw.sendall(data)
    except OSError:  # the server may have had enough of it
        pass
    return raw


def reset(raw):
    """Ends a connection in the rudest way, with RST."""
    raw.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    raw.close()

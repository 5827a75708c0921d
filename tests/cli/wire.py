# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""A client of `vla serve` that writes the bytes of docs/protocol.md itself."""

import struct

import zmq


def _varint(value):
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes(out) + bytes([value])


def _bytes(number, value):
    return _varint(number << 3 | 2) + _varint(len(value)) + value


def _number(number, value):
    return _varint(number << 3) + _varint(value)


def rgb(width, height):
    """A black frame without encoding."""
    return _number(1, width) + _number(2, height) + _bytes(3, bytes(3 * width * height))


def act(request_id, golden, seed=None, deadline_ms=None, text=None, image=None, n_image=1, has_text=True):
    """The act that a golden case is, its images as PNG. `image` is (tag of its field, file) of another for the first
    `n_image` views."""
    files = [(b"\x22", file.read_bytes()) if file else (b"\x2a", b"") for file in golden.images.values()]
    files[:n_image] = files[:n_image] if image is None else [image] * n_image
    views = b"".join(
        _bytes(1, _bytes(1, name.encode()) + tag + _varint(len(file)) + file)
        for name, (tag, file) in zip(golden.images, files, strict=True)
    )
    features = golden.state if isinstance(golden.state, dict) else {"state": golden.state}
    states = b"".join(
        _bytes(2, _bytes(1, name.encode()) + _bytes(2, struct.pack(f"<{len(state)}f", *state)))
        for name, state in features.items()
    )
    body = views + states + (_bytes(3, (golden.text if text is None else text).encode()) if has_text else b"")
    body += b"" if seed is None else _number(5, seed)
    body += b"" if deadline_ms is None else _number(7, deadline_ms)
    return _number(1, 1) + _number(2, request_id) + _bytes(5, body)


def hello(request_id, name, version):
    body = _number(1, 1) + _number(2, 1) + _bytes(3, name.encode()) + _bytes(4, version.encode())
    return _number(1, 1) + _number(2, request_id) + _bytes(3, body)


def health(request_id):
    return _number(1, 1) + _number(2, request_id) + _bytes(6, b"")


def describe(request_id):
    return _number(1, 1) + _number(2, request_id) + _bytes(4, b"")


class Peer:
    def __init__(self, address):
        self.socket = zmq.Context.instance().socket(zmq.DEALER)
        self.socket.linger = 0
        self.socket.rcvtimeo = 30_000
        self.socket.connect(address)

    def ask(self, request):
        """The bytes of the answer."""
        self.socket.send(request)
        return self.socket.recv()

    def close(self):
        self.socket.close()


def kind(response):
    """Which answer it is: the number of the field after version and request id."""
    at, number = 0, None
    while at < len(response):
        tag, at = _read(response, at)
        number, value = tag >> 3, None
        value, at = _read(response, at)
        at += value if tag & 7 == 2 else 0
    return {3: "hello", 4: "description", 5: "chunk", 6: "health", 7: "error"}[number]


def _read(data, at):
    value = shift = 0
    while True:
        byte = data[at]
        value |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return value, at


def _fields(data):
    """(number, value) of every field; bytes for what has a length."""
    at = 0
    while at < len(data):
        tag, at = _read(data, at)
        size = {1: 8, 5: 4}.get(tag & 7)
        if tag & 7 == 0:
            value, at = _read(data, at)
            yield tag >> 3, value
            continue
        if size is None:
            size, at = _read(data, at)
        yield tag >> 3, data[at : at + size]
        at += size


def actions(response):
    """The bytes of a chunk's actions."""
    (chunk,) = (value for number, value in _fields(response) if number == 5)
    return b"".join(value for number, value in _fields(chunk) if number == 3)

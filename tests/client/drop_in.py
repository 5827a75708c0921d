# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Clients of other policy servers, written from what goes over the wire, and the server that answers them."""

import contextlib
import io
import re
import signal
import socket
import subprocess

import msgpack
import numpy as np
from hostile import UPGRADE, websocket_frame
from server_process import SECONDS, VLA


@contextlib.contextmanager
def serving(case, *options, stops=False):
    """A running `vla serve`: its ready line, and the address of a protocol by what it begins with. `stops`: a client ends it."""
    command = [VLA, "serve", case.bundle, "--bind", "tcp://127.0.0.1:0", "--threads", "1", *map(str, options)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    line = process.stdout.readline()
    try:
        assert line.startswith("ready "), process.stderr.read()
        addresses = re.search(r"address=(\S+)", line)[1].split(",")
        yield line, lambda scheme: next(a for a in addresses if a.startswith(scheme))
    finally:
        if not stops:
            process.send_signal(signal.SIGTERM)
        assert process.wait(SECONDS) == 0
        process.stdout.close(), process.stderr.close()


def openpi_array(array, key=str.encode):
    return {
        key("__ndarray__"): True,
        key("data"): array.tobytes(),
        key("dtype"): array.dtype.str,
        key("shape"): array.shape,
    }


def numpy_array(array):
    """The layout of the package msgpack-numpy."""
    return {b"nd": True, b"type": array.dtype.str, b"kind": b"", b"shape": array.shape, b"data": array.tobytes()}


def npy_array(array):
    file = io.BytesIO()
    np.save(file, array, allow_pickle=False)
    return {"__ndarray_class__": True, "as_npy": file.getvalue()}


def pack(value, array):
    return msgpack.packb(value, default=array)


def _object(value):
    if b"__ndarray__" in value:
        return np.ndarray(buffer=value[b"data"], dtype=value[b"dtype"], shape=value[b"shape"])
    if value.get(b"nd"):
        return np.ndarray(buffer=value[b"data"], dtype=value[b"type"], shape=value[b"shape"])
    if "__ndarray_class__" in value:
        return np.load(io.BytesIO(value["as_npy"]), allow_pickle=False)
    return value


def unpack(data):
    return msgpack.unpackb(data, object_hook=_object, strict_map_key=False)


class WebSocket:
    """The client's side of RFC 6455, with as much of it as openpi's clients use, and without manners."""

    def __init__(self, address, path="/", headers=()):
        host, port = re.fullmatch(r"(?:ws://)?([\d.]+):(\d+)", address).groups()
        self.socket = socket.create_connection((host, int(port)), SECONDS)
        self.file = self.socket.makefile("rb")
        head = UPGRADE.replace(b" / ", f" {path} ".encode())
        self.socket.sendall(head[:-2] + "".join(f"{line}\r\n" for line in headers).encode() + b"\r\n")
        self.status = int(self.file.readline().split()[1])
        while self.file.readline().strip():
            pass

    def send(self, payload, opcode=2):
        self.socket.sendall(websocket_frame(0x80 | opcode, payload))

    def receive(self):
        """Opcode and payload of the next frame; None at the end."""
        head = self.file.read(2)
        if len(head) < 2:
            return None
        size = head[1] & 0x7F
        if size >= 126:
            size = int.from_bytes(self.file.read(2 if size == 126 else 8), "big")
        return head[0] & 0x0F, self.file.read(size)

    def ask(self, payload):
        self.send(payload)
        opcode, answer = self.receive()
        while opcode == 9:
            self.send(answer, opcode=10)
            opcode, answer = self.receive()
        assert opcode == 2, answer
        return unpack(answer)

    def close(self):
        self.file.close()
        self.socket.close()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""As much of HTTP/2 (RFC 9113) and gRPC as a peer needs to misuse it."""

import select
import struct

PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"
DATA, HEADERS, RST_STREAM, SETTINGS, PING, GOAWAY, WINDOW_UPDATE = 0, 1, 3, 4, 6, 7, 8
END_STREAM, ACK, END_HEADERS = 1, 1, 4
INITIAL_WINDOW_SIZE = 4


def frame(kind, flags, stream, payload=b""):
    return struct.pack(">I", len(payload))[1:] + struct.pack(">BBI", kind, flags, stream) + payload


def headers(path):
    """A call of gRPC: POST and http by their places in the static table (RFC 7541), the others as they are."""

    def text(value):
        return bytes([len(value)]) + value

    named = [(b"content-type", b"application/grpc"), (b"te", b"trailers")]
    block = b"\x83\x86\x04" + text(path.encode()) + b"\x01" + text(b"robot")
    return block + b"".join(b"\x00" + text(name) + text(value) for name, value in named)


def message(data, length=None):
    """As gRPC frames it; `length`: what it announces."""
    return b"\x00" + struct.pack(">I", len(data) if length is None else length) + data


class Calls:
    """The client's end of a connection: calls of gRPC that stay within the windows that the server gives."""

    def __init__(self, raw):
        self.raw = raw
        self._n_stream, self._initial = -1, 65535
        self._windows = {0: 65535}
        self._ended = set()
        raw.sendall(PREFACE + frame(SETTINGS, 0, 0))

    def begin(self, path):
        """The number of a call that is begun."""
        self._n_stream += 2
        self._windows[self._n_stream] = self._initial
        self.raw.sendall(frame(HEADERS, END_HEADERS, self._n_stream, headers(path)))
        return self._n_stream

    def send(self, call, data, is_last=False):
        """OSError where the call or the connection ends meanwhile."""
        while data or is_last:
            while select.select([self.raw], [], [], 0)[0]:
                self._take_frame()
            if call in self._ended:
                raise ConnectionError("the server ended the call")
            room = min(self._windows[0], self._windows[call], 16384)
            if data and room <= 0:
                self._take_frame()
                continue
            piece, data = data[:room], data[room:]
            self._windows[0] -= len(piece)
            self._windows[call] -= len(piece)
            ends = is_last and not data
            self.raw.sendall(frame(DATA, END_STREAM if ends else 0, call, piece))
            if ends:
                return

    def wait(self, call):
        """Until the server has ended it."""
        while call not in self._ended:
            self._take_frame()

    def _take_frame(self):
        head = self._take(9)
        payload = self._take(int.from_bytes(head[:3], "big"))
        kind, flags, stream = struct.unpack(">BBI", head[3:])
        if kind == SETTINGS and not flags & ACK:
            for name, value in struct.iter_unpack(">HI", payload):
                if name == INITIAL_WINDOW_SIZE:
                    for open_stream in self._windows.keys() - {0}:
                        self._windows[open_stream] += value - self._initial
                    self._initial = value
            self.raw.sendall(frame(SETTINGS, ACK, 0))
        elif kind == PING and not flags & ACK:
            self.raw.sendall(frame(PING, ACK, 0, payload))
        elif kind == WINDOW_UPDATE:
            if stream in self._windows:
                self._windows[stream] += int.from_bytes(payload, "big")
        elif kind == GOAWAY:
            raise ConnectionError("the server goes away")
        elif kind == RST_STREAM or (kind in (DATA, HEADERS) and flags & END_STREAM):
            self._windows.pop(stream, None)
            self._ended.add(stream)

    def _take(self, n):
        data = b""
        while len(data) < n:
            part = self.raw.recv(n - len(data))
            if not part:
                raise ConnectionError("the server ended the connection")
            data += part
        return data

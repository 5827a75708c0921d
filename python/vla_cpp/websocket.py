# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""One WebSocket connection whose calls end in time, whatever the server does. Needs the extra `openpi`.

The package websockets implements the protocol. This module owns the socket, so that every wait ends when the caller's time is over, also
for a server that does not read, sends a byte now and then, or pings endlessly.
"""

from __future__ import annotations

import contextlib
import socket
import ssl
import time
from typing import Any, Dict, List, Union

from .installed import extra_hint

try:
    from websockets.client import ClientProtocol
    from websockets.exceptions import WebSocketException
    from websockets.frames import Frame, Opcode
    from websockets.uri import parse_uri
except ImportError as error:
    raise ImportError(f"{error}; {extra_hint('openpi')}") from error

PIECE = 1 << 14  # bytes per read: at most 8192 empty frames, which take the package 0.1 s


class WebSocket:
    """A connection. `until` of its calls: when the call must end, by time.monotonic(). Errors of all: TimeoutError, OSError,
    WebSocketException."""

    def __init__(self, url: str, headers: Dict[str, str], max_message: int, until: float) -> None:
        uri = parse_uri(url)
        self._protocol = ClientProtocol(uri, max_size=max_message)
        self._messages: List[Union[bytes, str]] = []
        self._part, self._is_text = bytearray(), False
        self._socket = _connected(uri.host, uri.port, until)
        try:
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, True)
            if uri.secure:
                self._socket.settimeout(_left(until))
                self._socket = ssl.create_default_context().wrap_socket(self._socket, server_hostname=uri.host)
            request = self._protocol.connect()
            request.headers.update(headers)
            self._protocol.send_request(request)
            self._is_open = False
            while not self._is_open:
                self._exchange(until)
        except BaseException:
            self.close()
            raise

    def send(self, message: bytes, until: float) -> None:
        self._protocol.send_binary(message)
        self._flush(until)

    def receive(self, until: float) -> Union[bytes, str]:
        while not self._messages:
            self._exchange(until)
        return self._messages.pop(0)

    def is_silent(self) -> bool:
        """Whether the connection is alive and no message has arrived since the last answer. Answers pings. Does not wait."""
        try:
            for _ in range(4):  # a server may ping endlessly
                self._exchange(time.monotonic() + 0.001, wait=False)
        except (BlockingIOError, ssl.SSLWantReadError):
            return not self._messages and not self._part
        except (OSError, WebSocketException):
            pass
        return False

    def close(self) -> None:
        """Closes immediately, without the closing handshake, for which a computing server would make the caller wait."""
        with contextlib.suppress(OSError):
            self._socket.close()

    def _exchange(self, until: float, wait: bool = True) -> None:
        """Receives once, with `wait` after waiting for data, and answers the server's pings."""
        self._flush(until)
        self._socket.settimeout(_left(until) if wait else 0.0)
        data = self._socket.recv(PIECE)
        if data:
            self._protocol.receive_data(data)
        else:
            self._protocol.receive_eof()
        for event in self._protocol.events_received():
            if isinstance(event, Frame):
                self._take(event)
            else:
                self._is_open = self._protocol.handshake_exc is None
        problem = self._protocol.handshake_exc or self._protocol.parser_exc
        if problem and not isinstance(problem, EOFError):
            raise problem if isinstance(problem, (OSError, WebSocketException)) else OSError(str(problem))
        if self._messages:
            return
        if self._protocol.close_rcvd is not None:
            raise ConnectionError(f"the server closed the connection: {self._protocol.close_rcvd}")
        if not data:
            raise ConnectionError("the server ended the connection")
        self._flush(until)

    def _take(self, frame: Any) -> None:
        if frame.opcode not in (Opcode.TEXT, Opcode.BINARY, Opcode.CONT):
            return
        if frame.opcode is not Opcode.CONT:
            self._is_text = frame.opcode is Opcode.TEXT
        self._part += frame.data
        if frame.fin:
            whole, self._part = bytes(self._part), bytearray()
            self._messages.append(whole.decode("utf-8", "replace") if self._is_text else whole)

    def _flush(self, until: float) -> None:
        for data in self._protocol.data_to_send():
            rest = memoryview(data)
            while rest:
                self._socket.settimeout(_left(until))
                rest = rest[self._socket.send(rest) :]


def _left(until: float) -> float:
    left = until - time.monotonic()
    if left <= 0:
        raise TimeoutError
    return left


def _connected(host: str, port: int, until: float) -> socket.socket:
    """A socket connected to the host's first address that answers."""
    problem: OSError = OSError(f"no address of {host}")
    for family, kind, number, _, address in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM):
        made = socket.socket(family, kind, number)
        try:
            made.settimeout(_left(until))
            made.connect(address)
            return made
        except OSError as refused:
            made.close()
            problem = refused
    raise problem

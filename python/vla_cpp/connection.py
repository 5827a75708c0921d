# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""One connection to a server: a DEALER socket, and a monitor that reports when the server disconnects.

A connection is never reused after a loss or a timeout. It is closed and a new one is made, so that no answer to an earlier request
can arrive on it.
"""

from __future__ import annotations

import math
import os
import struct
from pathlib import Path
from typing import FrozenSet, List, Optional, Tuple, Union

import zmq
from zmq.utils import z85
from zmq.utils.monitor import recv_monitor_message

from .answer import MAX_ANSWER
from .errors import Disconnected, UsageError

HEARTBEAT_MS = 1000  # a server that is cut off without a disconnect is noticed after three heartbeats
RECONNECT_MS = 100
MAX_WAITING = 8  # received answers that are not read yet; a server with more has to wait

_REFUSED = zmq.EVENT_HANDSHAKE_FAILED_AUTH | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL


def curve_keys(server: Union[str, os.PathLike], secret: Union[str, os.PathLike]) -> Tuple[bytes, bytes, bytes]:
    """The argument `curve` of a Connection, from keys or key files. Errors: UsageError, which does not show the key."""
    server_key, secret_key = _key("server_key", server), _key("secret_key", secret)
    return server_key, zmq.curve_public(secret_key), secret_key


def _key(where: str, given: Union[str, os.PathLike]) -> bytes:
    try:
        is_key = isinstance(given, str) and len(given) == 40
        text = str(given) if is_key else Path(given).read_text(encoding="ascii").strip()
        if len(text) != 40 or len(z85.decode(text)) != 32:
            raise ValueError("something else")
        return text.encode()
    except (OSError, ValueError, TypeError, KeyError, struct.error) as error:
        hint = "vla keygen makes them"
        raise UsageError(where, "a key of 40 characters, or the file of one", type(error).__name__, hint) from None


class Connection:
    def __init__(self, context: zmq.Context, address: str, curve: Optional[Tuple[bytes, bytes, bytes]]) -> None:
        """curve: the server's public key, our public key, our secret key. Errors: UsageError for an impossible address."""
        self._address = address
        self.features: FrozenSet[str] = frozenset()  # the server's, empty until it answers the Hello
        self._curve = bool(curve)
        self._socket = context.socket(zmq.DEALER)
        self._socket.linger = 0
        self._socket.setsockopt(zmq.HEARTBEAT_IVL, HEARTBEAT_MS)
        self._socket.setsockopt(zmq.HEARTBEAT_TIMEOUT, 3 * HEARTBEAT_MS)
        self._socket.setsockopt(zmq.RECONNECT_IVL, RECONNECT_MS)
        self._socket.setsockopt(zmq.MAXMSGSIZE, MAX_ANSWER)  # a larger frame ends the connection
        self._socket.setsockopt(zmq.RCVHWM, MAX_WAITING)
        self._monitor = self._socket.get_monitor_socket(zmq.EVENT_DISCONNECTED | _REFUSED)
        self._poller = zmq.Poller()
        self._poller.register(self._socket, zmq.POLLIN)
        self._poller.register(self._monitor, zmq.POLLIN)
        try:
            if curve:
                self._socket.curve_serverkey, self._socket.curve_publickey, self._socket.curve_secretkey = curve
            self._socket.connect(address)
        except (zmq.ZMQError, ValueError) as error:
            self.close()
            raise UsageError(address, "an address like tcp://127.0.0.1:5555", str(error)) from None

    def send(self, data: bytes) -> None:
        """Sends without waiting: the socket queues the message until it is connected. Errors: Disconnected for a full queue."""
        try:
            self._socket.send(data, zmq.DONTWAIT, copy=False)
        except zmq.Again:
            raise Disconnected(self._address, "a server that reads", "a full queue", "ask less often") from None

    def receive(self, seconds: float) -> List[List[bytes]]:
        """Waits up to `seconds` for a message and returns it with others that have arrived. Errors: Disconnected.

        After a loss, messages that arrived before it are returned first; the next call raises Disconnected.
        """
        events = dict(self._poller.poll(max(0, math.ceil(seconds * 1000))))
        messages: List[List[bytes]] = []
        while self._socket in events and len(messages) < MAX_WAITING:  # a server that sends endlessly must not block the caller
            try:
                messages.append(self._socket.recv_multipart(zmq.DONTWAIT))
            except zmq.Again:
                break
        if self._monitor in events and not messages:
            self._check(recv_monitor_message(self._monitor)["event"])
        return messages

    def _check(self, event: int) -> None:
        if event & _REFUSED:
            keys = (
                "check the keys, and that the server admits this client's"
                if self._curve
                else "does the server want CURVE keys?"
            )
            raise Disconnected(self._address, "a handshake", "a refusal", keys)
        raise Disconnected(self._address, "", "the connection was lost", "the next call connects anew")

    def close(self) -> None:
        self._socket.disable_monitor()
        self._monitor.close(0)
        self._socket.close(0)

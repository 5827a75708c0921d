# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The calls of LeRobot's robot_client, and the bytes of its messages. Calling needs grpcio."""

import threading
import time

from lerobot_pickles import dumps, loads
from server_process import SECONDS

PIECE = 2 << 20
BEGIN, MIDDLE, END = 1, 2, 3


def varint(n):
    out = b""
    while n > 127:
        out, n = out + bytes([n & 127 | 128]), n >> 7
    return out + bytes([n])


def field(number, data):
    return bytes([number << 3 | 2]) + varint(len(data)) + data


def piece(state, data):
    return bytes([8, state]) + field(2, data)


def data_of(message):
    """The field 1 of an answer."""
    if not message:
        return b""
    at = 1
    while message[at] & 128:
        at += 1
    return message[at + 1 :]


def halves(n, pause=0.3):
    """So many pieces of 2 MB of an observation, whose end does not come."""
    for i in range(n):
        yield piece(BEGIN if i == 0 else MIDDLE, bytes(PIECE))
        time.sleep(pause)
    threading.Event().wait(SECONDS)


class Robot:
    """The calls of LeRobot's robot_client."""

    def __init__(self, address):
        import grpc

        self.channel = grpc.insecure_channel(address.removeprefix("grpc://"))

        def call(kind, name):
            method = getattr(self.channel, kind)(f"/transport.AsyncInference/{name}", None, None)
            return lambda message: method(message, timeout=SECONDS, wait_for_ready=True)

        self._ready, self._setup = call("unary_unary", "Ready"), call("unary_unary", "SendPolicyInstructions")
        self._observe, self._actions = call("stream_unary", "SendObservations"), call("unary_unary", "GetActions")
        self.other = call("unary_unary", "Other")

    def begin(self, setup):
        self._ready(b"")
        self._setup(field(1, setup if isinstance(setup, bytes) else dumps(setup)))

    def observe(self, observation, protocol=4):
        data = observation if isinstance(observation, bytes) else dumps(observation, protocol)
        parts = [data[i : i + PIECE] for i in range(0, len(data), PIECE)]
        states = [BEGIN if i == 0 else MIDDLE for i in range(len(parts) - 1)] + [END]
        self._observe(iter([piece(*both) for both in zip(states, parts)]))

    def actions(self):
        data = data_of(self._actions(b""))
        return loads(data) if data else None

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.channel.close()

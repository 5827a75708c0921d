# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The calls of LeRobot's robot_client, and the bytes of its messages. Robot needs grpcio."""

import contextlib

import hostile
import http2
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


class Peer:
    """The same calls from an address of choice, without gRPC's library, and what they should not be."""

    def __init__(self, address, source):
        self.raw = hostile.connect(address, source=source)
        self._calls = http2.Calls(self.raw)

    def ask(self, name, *messages):
        """A call, until it is answered."""
        call = self.begin(name)
        for i, message in enumerate(messages):
            self._calls.send(call, http2.message(message), is_last=i == len(messages) - 1)
        self._calls.wait(call)

    def begin(self, name):
        return self._calls.begin(f"/transport.AsyncInference/{name}")

    def half(self, n_byte):
        """So many bytes of an observation whose end does not come."""
        call = self.begin("SendObservations")
        for at in range(0, n_byte, PIECE):
            part = piece(MIDDLE if at else BEGIN, bytes(min(PIECE, n_byte - at)))
            self._calls.send(call, http2.message(part))
            yield

    def half_message(self, n_byte):
        """So many bytes of a piece whose end does not come: gRPC itself holds them."""
        self._calls.send(self.begin("SendObservations"), http2.message(bytes(n_byte), PIECE))

    def wait(self):
        """Until the server ends the connection."""
        self._calls.wait(None)

    def setup(self, setup):
        self.ask("Ready", b"")
        self.ask("SendPolicyInstructions", field(1, setup if isinstance(setup, bytes) else dumps(setup)))

    def observe(self, observation):
        self.ask("SendObservations", *pieces(observation))

    def actions(self):
        self.ask("GetActions", b"")

    def act(self, observation):
        self.observe(observation)
        self.actions()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        with contextlib.suppress(OSError):
            self.raw.close()


def pieces(data):
    """The messages of an observation."""
    parts = [data[i : i + PIECE] for i in range(0, len(data), PIECE)]
    states = [BEGIN if i == 0 else MIDDLE for i in range(len(parts) - 1)] + [END]
    return [piece(*both) for both in zip(states, parts)]


class Robot:
    """The calls of LeRobot's robot_client. patience: seconds of each."""

    def __init__(self, address, patience=SECONDS):
        import grpc

        # A connection of its own: gRPC shares one between channels of a process, and a server tells robots by it.
        options = [("grpc.use_local_subchannel_pool", 1), ("grpc.initial_reconnect_backoff_ms", 100), ("grpc.min_reconnect_backoff_ms", 100)]
        self.channel = grpc.insecure_channel(address.removeprefix("grpc://"), options)

        def call(kind, name):
            method = getattr(self.channel, kind)(f"/transport.AsyncInference/{name}", None, None)
            return lambda message: method(message, timeout=patience, wait_for_ready=True)

        self._ready, self._setup = call("unary_unary", "Ready"), call("unary_unary", "SendPolicyInstructions")
        self._observe, self._actions = call("stream_unary", "SendObservations"), call("unary_unary", "GetActions")
        self.other = call("unary_unary", "Other")

    def begin(self, setup):
        self._ready(b"")
        self._setup(field(1, setup if isinstance(setup, bytes) else dumps(setup)))

    def observe(self, observation, protocol=4):
        data = observation if isinstance(observation, bytes) else dumps(observation, protocol)
        self._observe(iter(pieces(data)))

    def actions(self):
        data = data_of(self._actions(b""))
        return loads(data) if data else None

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.channel.close()

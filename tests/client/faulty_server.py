# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""A server that misbehaves on purpose, in ways in which `vla serve` does not: what it does with an act is said per test."""

import threading

import zmq

from vla_cpp import wire

HORIZON, D_ACTION = 4, 2


def description():
    message = wire.MESSAGES["Description"](horizon=HORIZON, noise_rows=HORIZON, d_noise=3, noise_kind="normal", rate_hz=20)
    message.views.add(name="observation.images.top", width=64, height=64)
    state = message.states.add(name="observation.state")
    for name in ("a", "b"):
        state.dimensions.add(name=name)
        message.actions.add(name=name)
    message.bundle.name, message.bundle.checksum = "double.gguf", "xxh3:1"
    message.limits.max_message_bytes, message.limits.max_pixels = 1 << 20, 1 << 16
    return message


def chunk(value, **fields):
    """A chunk whose actions are all `value`."""
    message = wire.MESSAGES["ActionChunk"](horizon=HORIZON, d_action=D_ACTION, actions=[value] * (HORIZON * D_ACTION), names=["a", "b"])
    message.bundle.name, message.bundle.checksum = "double.gguf", "xxh3:1"
    for name, field in fields.items():
        setattr(message, name, field)
    return message


def response(request, **kind):
    """An answer to the request. A chunk tells its seed and its capture time, unless it has others."""
    told = kind.get("chunk")
    if told is not None and request.act.HasField("seed") and not told.HasField("seed"):
        told.seed = request.act.seed
    if told is not None and not told.capture_time_ns:
        told.capture_time_ns = request.act.capture_time_ns
    return wire.Response(protocol_version=1, request_id=request.request_id, **kind)


class FaultyServer:
    """on_act(request) returns the list of what is sent for it: responses, or bytes as they are; it may keep requests for later."""

    def __init__(self):
        self._socket = zmq.Context.instance().socket(zmq.ROUTER)
        self._socket.linger = 0
        self.address = f"tcp://127.0.0.1:{self._socket.bind_to_random_port('tcp://127.0.0.1')}"
        self.kinds = []  # of the requests, in order
        self.acts = []
        self.peers = set()
        self.on_act = lambda request: [response(request, chunk=chunk(request.act.seed))]
        self.description = description()
        self.on_hello = lambda request: [
            response(request, hello=wire.MESSAGES["HelloReply"](min_version=1, max_version=1))
        ]
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self):
        while not self._stopped.is_set():
            if not self._socket.poll(20):
                continue
            peer, data = self._socket.recv_multipart()
            self.peers.add(peer)
            request = wire.Request.FromString(data)
            for answer in self._answers(request):
                self._socket.send_multipart([peer, answer if isinstance(answer, bytes) else answer.SerializeToString()])

    def _answers(self, request):
        kind = request.WhichOneof("kind")
        self.kinds.append(kind)
        if kind == "hello":
            return self.on_hello(request)
        if kind == "describe":
            return [response(request, description=self.description)]
        if kind == "health":
            return [response(request, health=wire.MESSAGES["HealthReply"](ready=True))]
        self.acts.append(request)
        return self.on_act(request)

    def stop(self):
        self._stopped.set()
        self._thread.join()
        self._socket.close(0)

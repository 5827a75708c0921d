# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""A policy at `vla serve`."""

from __future__ import annotations

import os
import random
import threading
import time
from dataclasses import replace
from typing import Any, Callable, Dict, FrozenSet, Mapping, Optional, Sequence, Union

import zmq
from google.protobuf.message import DecodeError

from . import __version__, wire
from .answer import Asked, check_same_policy
from .chunk import Chunk
from .connection import Connection, curve_keys
from .errors import Disconnected, Incompatible, Timeout, UsageError, VlaError
from .frozen import CameraWatch
from .handle import Handle, wrong_process
from .observation import Image, Leftover, State, check_absent, check_start, robot_of, with_absent
from .pending import Health, Pending
from .printable import printable
from .spec import Spec


class Client(Handle):
    """Speaks with a server: `act` sends an observation and returns a chunk.

        with vla_cpp.Client("tcp://127.0.0.1:5555") as policy:
            chunk = policy.act(images={"top": frame}, state=q, text="open the drawer")

    address             tcp://HOST:PORT or ipc://PATH
    policy              name of the policy, where the server has several. A client that names its policy keeps working after
                        `vla ctl load` replaces it by another version, which has the same views, states and actions; `chunk.bundle`
                        says which version answered
    timeout             seconds that a call may take, connecting included
    server_key          public key of a server with CURVE, and
    secret_key          this client's secret key: 40 characters each, or the files of `vla keygen` (server.public, robot.secret)
    absent              views that the robot does not have, e.g. `["camera3"]`: no `act` needs to declare them, and none may give their image

    The first call connects. If the connection is lost or the server does not answer in time, the call raises and the next call
    reconnects, so that a program survives a restart of its server. A restarted server with other weights is refused with Incompatible.

    Threads may share a client; their calls take turns. But a server keeps only the newest waiting observation of each client, so
    robots that act at the same time need a client each. A child process cannot use the client of its parent, nor can it be pickled.
    """

    def __init__(
        self,
        address: str,
        *,
        policy: Optional[str] = None,
        timeout: float = 10.0,
        server_key: Union[str, os.PathLike, None] = None,
        secret_key: Union[str, os.PathLike, None] = None,
        absent: Sequence[str] = (),
    ) -> None:
        if not timeout > 0:
            raise UsageError("timeout", "seconds above 0", str(timeout))
        if (server_key is None) != (secret_key is None):
            raise UsageError("CURVE", "server_key and secret_key", "one of them")
        self.address, self.policy, self.timeout, self._absent = address, policy, timeout, tuple(absent)
        self._curve = curve_keys(server_key, secret_key) if server_key is not None and secret_key is not None else None
        self._pid = os.getpid()
        self._lock = threading.RLock()
        self._context: Optional[zmq.Context] = zmq.Context()
        self._connection: Optional[Connection] = None
        self._pending: Dict[int, Pending] = {}
        # Request ids start at a random number, so that two clients, or two runs of one client, almost never use the same ids.
        self._last_id = random.SystemRandom().getrandbits(62)
        self._spec: Optional[Spec] = None
        self._limits: Any = None
        self._cameras = CameraWatch()
        try:
            self._connect()
        except VlaError:
            self.close()
            raise

    # --- what a user calls ---------------------------------------------------------------------------------------------------

    @property
    def spec(self) -> Spec:
        """The policy's inputs and outputs, requested once. Errors: Timeout, Disconnected, Incompatible."""
        return self._spec or self._learn(self.timeout)

    @property
    def features(self) -> FrozenSet[str]:
        """Optional capabilities of the server, listed in docs/protocol.md; empty before the server's first answer."""
        connection = self._connection
        return connection.features if connection else frozenset()

    def act(
        self,
        *,
        images: Mapping[str, Image],
        state: State,
        text: Optional[str] = None,
        seed: Optional[int] = None,
        noise: object = None,
        leftover: Optional[Leftover] = None,
        deadline_ms: Optional[float] = None,
        capture_time_ns: Optional[int] = None,
        timeout: Optional[float] = None,
        embodiment: Optional[str] = None,
    ) -> Chunk:
        """One observation in, one action chunk out.

        images           frames by view: uint8 (height, width, 3) RGB of any size, a Pillow image, the bytes of a JPEG or PNG file, or
                         None for a camera that the robot does not have
        state            world units: vectors by name, or one vector where the policy has one state
        text             the instruction in a person's words, which may be empty; None for a policy that reads none
        seed, noise      the solver's noise: a seed, or float32 (noise_rows, d_noise); with neither a seed is drawn, which
                         `chunk.seed` reports
        leftover         real-time chunking: the rows of the previous chunk that are not executed yet; see Leftover
        deadline_ms      milliseconds from the server's receipt of the request after which the answer is useless and not computed; by
                         default the timeout
        capture_time_ns  when the frames were taken; echoed in the chunk
        timeout          seconds, instead of the client's
        embodiment       tag of the robot, where `spec.robots` has several

        Errors: BadObservation (names the input that the policy cannot accept), Timeout, Disconnected, Superseded, Late, Busy, TooLarge,
        Incompatible, ShuttingDown, and those of the runtime: BadAction, DeviceError, OutOfMemory, InternalError.
        """
        return self.submit(
            images=images, state=state, text=text, seed=seed, noise=noise, leftover=leftover,
            deadline_ms=deadline_ms, capture_time_ns=capture_time_ns, timeout=timeout, embodiment=embodiment,
        ).result()  # fmt: skip

    def submit(
        self,
        *,
        seed: Optional[int] = None,
        noise: object = None,
        deadline_ms: Optional[float] = None,
        timeout: Optional[float] = None,
        embodiment: Optional[str] = None,
        loop: Optional[Mapping[str, Any]] = None,
        **observation: Any,
    ) -> Pending:
        """Sends the observation (arguments as of `act`) and returns at once: `done()` of the result never waits, `result()` is the chunk.

        `loop` has the fields of a LoopState (src/wire/vla.proto) and comes from a ChunkLoop; it is sent if `features` has "loop".
        Only the first call of a client may wait, for the description of the policy.
        """
        check_start(seed, noise)
        timeout = self.timeout if timeout is None else timeout
        deadline_ms = timeout * 1000 if deadline_ms is None else deadline_ms
        begun = time.monotonic()
        spec, limits = robot_of(self._spec or self._learn(timeout), embodiment), self._limits

        if self._absent:
            check_absent(self._absent, self.spec)
            observation["images"] = with_absent(observation.get("images", {}), self._absent, spec.views)

        def write(request: Any) -> bytes:
            request.act.policy = self.policy or ""
            if loop is not None and "loop" in self.features:
                request.act.loop.CopyFrom(wire.MESSAGES["LoopState"](**loop))
            return wire.act_bytes(request, spec, limits, seed=seed, noise=noise, deadline_ms=deadline_ms, **observation)

        capture_time_ns = observation.get("capture_time_ns")
        notes = self._cameras.notes(spec, observation.get("images", {}), observation.get("state"))
        asked = Asked(self.address, spec, seed, noise is not None, capture_time_ns, notes)
        return self._ask("chunk", timeout, write, asked, begun)

    def health(self, timeout: Optional[float] = None) -> Health:
        """The server's state; answered also while the server computes. Errors: Timeout, Disconnected, Incompatible."""
        return self._ask("health", self.timeout if timeout is None else timeout, _health).result()

    def close(self) -> None:
        """Closes the connection; pending requests end with Disconnected. A second call does nothing."""
        if os.getpid() != self._pid:
            return
        with self._lock:
            self._drop(Disconnected(self.address, "", "the client was closed"))
            if self._context is not None:
                self._context.term()
                self._context = None

    def __del__(self) -> None:
        if getattr(self, "_context", None) is not None and os is not None:  # `os` is None while the interpreter exits
            self.close()

    # --- requests and answers ------------------------------------------------------------------------------------------------

    def _learn(self, timeout: float) -> Spec:
        """Requests the policy's description. Two threads may both request it, so that neither waits for the other's timeout."""
        description = self._ask("description", timeout, self._describe).result()
        with self._lock:
            if self._spec is None:
                self._spec, self._limits = wire.spec_of(description), description.limits
            return self._spec

    def _ask(
        self, kind: str, timeout: float, write: Callable[[Any], bytes], asked: Optional[Asked] = None, begun: Optional[float] = None
    ) -> Pending:
        """Sends a request.

        kind     field of the Response that answers it
        timeout  seconds
        write    fills in the request and returns its bytes
        asked    facts that the answering chunk must match
        begun    time.monotonic() at which the timeout began; None: now
        """
        with self._lock:
            connection = self._connect()
            request = self._new_request()
            data = write(request)
            pending = Pending(self, request.request_id, kind, timeout, asked, begun)
            connection.send(data)
            self._pending[pending._id] = pending
            return pending

    def _new_request(self) -> Any:
        self._last_id += 1
        return wire.new_request(self._last_id)

    def _connect(self) -> Connection:
        """The connection, newly made with a Hello if there is none or it was lost. Does not wait."""
        self._check_process()
        if self._context is None:
            raise Disconnected(self.address, "an open client", "one that was closed")
        self._pump(0.0)
        if self._connection is None:
            self._connection = Connection(self._context, self.address, self._curve)
            hello = self._new_request()
            hello.hello.min_version = hello.hello.max_version = wire.PROTOCOL_VERSION
            hello.hello.client_name, hello.hello.client_version = "vla-cpp-python", __version__
            self._connection.send(hello.SerializeToString())
            if self._spec is not None:  # checks that the server still has the same policy
                self._connection.send(self._describe(self._new_request()))
        return self._connection

    def _check_process(self) -> None:
        if os.getpid() != self._pid:
            raise wrong_process(self, "use in a child process")

    def _settle(self, pending: Pending, seconds: float) -> bool:
        """Waits up to `seconds`, at most 0.05 s; whether the request is finished. Waiting threads take turns."""
        with self._lock:
            if not pending._is_over:
                self._check_process()
                self._pump(min(max(seconds, 0.0), 0.05))
            if not pending._is_over and time.monotonic() >= pending._until:
                hint = "is the server up, and its address right? `health()` tells; or give more time"
                pending._error = Timeout(self.address, f"an answer within {pending._timeout:g} s", "none", hint)
                del self._pending[pending._id]
                if not self._pending:  # the host may be down: the next request gets a new socket
                    self._drop(pending._error)
            return pending._is_over

    def _pump(self, seconds: float) -> None:
        """Receives messages, waiting up to `seconds` for the first, and assigns them to their requests."""
        if self._connection is None:
            return
        try:
            for frames in self._connection.receive(seconds):
                self._take(frames)
        except VlaError as error:
            self._drop(error)

    def _take(self, frames: list) -> None:
        try:
            if len(frames) != 1:
                raise DecodeError(f"{len(frames)} frames")
            response = wire.response_of(frames[0])
        except DecodeError as problem:
            found = printable(f"other bytes ({problem})")
            raise Incompatible(self.address, "answers of vla serve", found, "what listens there?") from None
        kind = response.WhichOneof("kind")
        error = wire.exception_of(response.error) if kind == "error" else None
        if isinstance(error, Incompatible) or (error and response.request_id == 0):
            raise error  # the server cannot read this client's requests: no other request will be answered either
        if response.protocol_version != wire.PROTOCOL_VERSION:
            found = f"version {response.protocol_version}"
            raise Incompatible(self.address, f"answers of protocol version {wire.PROTOCOL_VERSION}", found)
        if kind == "hello":
            self._connection.features = frozenset(response.hello.features)
        if kind in ("description", "chunk"):
            self._check_bundle(getattr(response, kind).bundle)
        if kind == "description" and self._spec is not None:
            check_same_policy(self.address, self._spec, wire.spec_of(response.description))
        pending = self._pending.pop(response.request_id, None)
        if pending is None:  # the answer to a Hello, or to a request that timed out
            return
        try:
            if error:
                raise error
            pending._answer = self._read(pending, kind, response)
        except VlaError as problem:
            pending._error = problem

    def _read(self, pending: Pending, kind: Optional[str], response: Any) -> Any:
        if kind != pending._kind:
            raise Incompatible(self.address, f"an answer of the kind {pending._kind}", kind or "none")
        if kind == "health":
            return Health(**{f.name: getattr(response.health, f.name) for f in response.health.DESCRIPTOR.fields})
        if kind == "description":
            return response.description
        chunk = wire.chunk_of(response.chunk)
        return pending._asked.check(chunk) if pending._asked else chunk

    def _check_bundle(self, bundle: Any) -> None:
        if self._spec is None or bundle.checksum == self._spec.bundle.checksum:
            return
        if self.policy is None:
            expected, found = (f"{b.name} ({b.checksum})" for b in (self._spec.bundle, bundle))
            raise Incompatible(self.address, expected, found, "make a new Client, and read its spec")
        self._spec = replace(self._spec, bundle=wire.bundle_of(bundle))  # the server ensures that nothing else differs

    def _describe(self, request: Any) -> bytes:
        request.describe.policy = self.policy or ""
        request.describe.SetInParent()
        return request.SerializeToString()

    def _drop(self, error: VlaError) -> None:
        """Closes the connection; every pending request ends with `error`."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None
        for pending in self._pending.values():
            pending._error = error
        self._pending.clear()


def _health(request: Any) -> bytes:
    request.health.SetInParent()
    return request.SerializeToString()

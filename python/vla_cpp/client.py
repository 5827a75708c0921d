# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""A policy at `vla serve`."""

from __future__ import annotations

import os
import random
import threading
import time
from dataclasses import dataclass
from typing import Any, Callable, Dict, Mapping, Optional, Union

import zmq
from google.protobuf.message import DecodeError

from . import __version__, wire
from .chunk import Chunk
from .connection import Connection
from .errors import Disconnected, Incompatible, Timeout, UsageError, VlaError
from .observation import Image, State, check_start
from .spec import BundleInfo, Spec


@dataclass(frozen=True)
class Health:
    """How the server is. uptime_s: seconds since it became ready. queue_depth: acts that wait, beside one that is computed."""

    ready: bool
    queue_depth: int
    computing: bool
    uptime_s: float
    chunks_served: int
    errors_served: int


class Pending:
    """An answer that is under way."""

    def __init__(self, client: Client, request_id: int, kind: str, timeout: float) -> None:
        self._client, self._id, self._kind = client, request_id, kind
        self._timeout, self._until = timeout, time.monotonic() + timeout
        self._answer: Any = None
        self._error: Optional[VlaError] = None

    def done(self) -> bool:
        """Whether `result` would return, or raise, at once. Never waits."""
        return self._client._settle(self, 0.0)

    def result(self) -> Any:
        """Waits for the answer, until the timeout that the request was made with. Errors: as `Client.act`."""
        while not self._client._settle(self, self._until - time.monotonic()):
            pass
        if self._error:
            raise self._error
        return self._answer

    @property
    def _is_over(self) -> bool:
        return self._answer is not None or self._error is not None


class Client:
    """Speaks with a server: `act` sends an observation and returns a chunk.

        with vla_cpp.Client("tcp://127.0.0.1:5555") as policy:
            chunk = policy.act(images={"top": frame}, state=q, text="open the drawer")

    address             tcp://HOST:PORT or ipc://PATH
    timeout             seconds that a call may take, connecting included
    server_key          the server's public CURVE key; with it go public_key and secret_key, the client's own (Z85, 40 characters)

    The first call connects. When the server goes away, or does not answer in time, the call raises and the next one connects anew,
    so that a program survives a restart of its server; a server that comes back with other weights is refused with Incompatible.

    Threads may share a client; their calls take turns. But a server keeps only the newest waiting observation of each client, so
    robots that act at the same time need a client each. A child process cannot use the client of its parent, nor can it be pickled.
    """

    def __init__(
        self,
        address: str,
        *,
        timeout: float = 10.0,
        server_key: Union[str, bytes, None] = None,
        public_key: Union[str, bytes, None] = None,
        secret_key: Union[str, bytes, None] = None,
    ) -> None:
        if not timeout > 0:
            raise UsageError("timeout", "seconds above 0", str(timeout))
        keys = [k.encode() if isinstance(k, str) else k for k in (server_key, public_key, secret_key)]
        if any(keys) and not all(keys):
            raise UsageError("CURVE", "server_key, public_key and secret_key", "some of them")
        self.address, self.timeout = address, timeout
        self._curve = tuple(keys) if all(keys) else None
        self._pid = os.getpid()
        self._lock = threading.RLock()
        self._context: Optional[zmq.Context] = zmq.Context()
        self._connection: Optional[Connection] = None
        self._pending: Dict[int, Pending] = {}
        # Ids start anywhere, so that two clients, or two lives of one, hardly ever use the same.
        self._last_id = random.SystemRandom().getrandbits(62)
        self._spec: Optional[Spec] = None
        self._limits: Any = None
        try:
            self._connect()
        except VlaError:
            self.close()
            raise

    # --- what a user calls ---------------------------------------------------------------------------------------------------

    @property
    def spec(self) -> Spec:
        """What the policy takes and gives; asked for once. Errors: Timeout, Disconnected, Incompatible."""
        with self._lock:
            if self._spec is None:
                description = self._ask("description", self.timeout, lambda r: r.describe.SetInParent()).result()
                self._spec, self._limits = wire.spec_of(description), description.limits
            return self._spec

    def act(
        self,
        *,
        images: Mapping[str, Image],
        state: State,
        text: str,
        seed: Optional[int] = None,
        noise: object = None,
        deadline_ms: Optional[float] = None,
        capture_time_ns: Optional[int] = None,
        timeout: Optional[float] = None,
    ) -> Chunk:
        """One observation in, one action chunk out.

        images           frames by view: uint8 (height, width, 3) RGB of any size, the bytes of a JPEG or PNG file, or None for a
                         camera that the robot does not have
        state            world units: vectors by name, or one vector where the policy has one state
        text             the instruction, as a person says it
        seed, noise      where the solver starts: a number, or float32 (horizon, d_noise); with neither the server draws a seed and
                         the chunk tells it
        deadline_ms      after so many milliseconds at the server the answer is worthless and not computed; the timeout by default
        capture_time_ns  when the frames were taken; comes back in the chunk
        timeout          seconds, instead of the client's

        Errors: BadObservation (what the policy cannot take, by name), Timeout, Disconnected, Superseded, Late, Busy, TooLarge,
        Incompatible, ShuttingDown, and what the runtime itself may raise: BadAction, DeviceError, OutOfMemory, InternalError.
        """
        return self.submit(
            images=images, state=state, text=text, seed=seed, noise=noise,
            deadline_ms=deadline_ms, capture_time_ns=capture_time_ns, timeout=timeout,
        ).result()  # fmt: skip

    def submit(
        self,
        *,
        images: Mapping[str, Image],
        state: State,
        text: str,
        seed: Optional[int] = None,
        noise: object = None,
        deadline_ms: Optional[float] = None,
        capture_time_ns: Optional[int] = None,
        timeout: Optional[float] = None,
    ) -> Pending:
        """Sends what `act` sends and returns at once: `done()` of the result never waits, `result()` is the chunk.

        Only the first call of a client may wait, for the description of the policy.
        """
        check_start(seed, noise)
        timeout = self.timeout if timeout is None else timeout
        spec = self.spec

        def fill(request: Any) -> None:
            wire.fill_act(
                request.act, spec, images=images, state=state, text=text, seed=seed, noise=noise,
                deadline_ms=timeout * 1000 if deadline_ms is None else deadline_ms, capture_time_ns=capture_time_ns,
            )  # fmt: skip

        return self._ask("chunk", timeout, fill)

    def health(self, timeout: Optional[float] = None) -> Health:
        """Answered also while the server computes. Errors: Timeout, Disconnected, Incompatible."""
        return self._ask(
            "health", self.timeout if timeout is None else timeout, lambda r: r.health.SetInParent()
        ).result()

    def close(self) -> None:
        """Ends the connection; requests under way end with Disconnected. A second call does nothing."""
        if os.getpid() != self._pid:
            return
        with self._lock:
            self._drop(Disconnected(self.address, "", "the client was closed"))
            if self._context is not None:
                self._context.term()
                self._context = None

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __del__(self) -> None:
        if getattr(self, "_context", None) is not None:
            self.close()

    def __reduce__(self):
        raise UsageError("Client", "use in the process that made it", "pickling", "make one per process")

    # --- requests and answers ------------------------------------------------------------------------------------------------

    def _ask(self, kind: str, timeout: float, fill: Callable[[Any], None]) -> Pending:
        """Sends a request that `fill` completes. kind: the field of the Response that answers it."""
        with self._lock:
            self._connect()
            request = self._new_request()
            fill(request)
            data = request.SerializeToString()
            if kind == "chunk":
                wire.check_limits(request.act, len(data), self._limits)
            pending = Pending(self, request.request_id, kind, timeout)
            self._connection.send(data)
            self._pending[pending._id] = pending
            return pending

    def _new_request(self) -> Any:
        self._last_id += 1
        return wire.new_request(self._last_id)

    def _connect(self) -> None:
        """A connection that is alive as far as one can know, greeted. Does not wait for anything."""
        self._check_process()
        if self._context is None:
            raise Disconnected(self.address, "an open client", "one that was closed")
        if self._connection is not None:
            self._pump(0.0)
        if self._connection is None:
            self._connection = Connection(self._context, self.address, self._curve)
            hello = self._new_request()
            hello.hello.min_version = hello.hello.max_version = wire.PROTOCOL_VERSION
            hello.hello.client_name, hello.hello.client_version = "vla-cpp-python", __version__
            self._connection.send(hello.SerializeToString())

    def _check_process(self) -> None:
        if os.getpid() != self._pid:
            raise UsageError("Client", "use in the process that made it", "another process", "make one per process")

    def _settle(self, pending: Pending, seconds: float) -> bool:
        """Whether the request is over, after waiting at most so long. Threads that wait take turns, in short slices."""
        with self._lock:
            if not pending._is_over and self._connection is not None:
                self._check_process()
                self._pump(min(max(seconds, 0.0), 0.05))
            if not pending._is_over and time.monotonic() >= pending._until:
                # A fresh socket for what comes next: this one may lead to a host that will never answer.
                hint = "is the server up, and its address right? `health()` tells; or give more time"
                pending._error = Timeout(self.address, f"an answer within {pending._timeout:g} s", "none", hint)
                del self._pending[pending._id]
                self._drop(
                    Disconnected(self.address, "", "another request timed out, and with it the connection ended")
                )
            return pending._is_over

    def _pump(self, seconds: float) -> None:
        """Takes what has come and hands it to those who asked."""
        try:
            for frames in self._connection.receive(seconds):
                self._take(frames)
        except VlaError as error:
            self._drop(error)

    def _take(self, frames: list) -> None:
        try:
            if len(frames) != 1:
                raise DecodeError(f"{len(frames)} frames")
            response = wire.Response.FromString(frames[0])
        except DecodeError as error:
            raise Incompatible(
                self.address, "answers of vla serve", f"other bytes ({error})", "what listens there?"
            ) from None
        kind = response.WhichOneof("kind")
        error = wire.exception_of(response.error) if kind == "error" else None
        if isinstance(error, Incompatible) or (error and response.request_id == 0):
            raise error  # the server could not read what it got, or never will: nothing else will be answered either
        if response.protocol_version != wire.PROTOCOL_VERSION:
            found = f"version {response.protocol_version}"
            raise Incompatible(self.address, f"answers of protocol version {wire.PROTOCOL_VERSION}", found)
        pending = self._pending.pop(response.request_id, None)
        if pending is None:  # to a hello, or to a request that nobody waits for
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
        self._check_bundle(chunk.bundle)
        return chunk

    def _check_bundle(self, bundle: BundleInfo) -> None:
        known = self._spec.bundle if self._spec else bundle
        if bundle.checksum != known.checksum:
            hint = "make a new Client, and read its spec"
            raise Incompatible(
                self.address, f"{known.name} ({known.checksum})", f"{bundle.name} ({bundle.checksum})", hint
            )

    def _drop(self, error: VlaError) -> None:
        """Ends the connection, and with it every request under way."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None
        for pending in self._pending.values():
            pending._error = error
        self._pending.clear()

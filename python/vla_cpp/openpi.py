# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""A policy at any server that speaks openpi's protocol: msgpack over WebSocket. Needs the extra `openpi`.

Whatever a server sends is data: arrays come as bytes with a dtype, and nothing of it is executed.
"""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from typing import Any, Dict, List, Mapping, Optional, Sequence, Tuple

import numpy as np

from .chunk import Chunk
from .errors import BadObservation, Disconnected, Incompatible, Timeout, Unsupported, UsageError, VlaError, error_of
from .handle import Handle
from .installed import extra_hint
from .observation import floats, image_arg, is_pillow, named
from .spec import BundleInfo

try:
    import msgpack
    from websockets.exceptions import WebSocketException
    from websockets.sync.client import connect
except ImportError as error:
    raise ImportError(f"{error}; {extra_hint('openpi')}") from error

MAX_ANSWER = 64 << 20  # bytes
TEXT = "text"  # what the key of the instruction stands for


class OpenpiClient(Handle):
    """Speaks with a policy server of openpi, or with `vla serve --openpi`.

        names = ["observation/image=top", "observation/wrist_image=wrist", "observation/state=arm", "prompt=text"]
        with OpenpiClient("openpi://127.0.0.1:8000", names) as policy:
            chunk = policy.act(images={"top": frame, "wrist": other}, state={"arm": q}, text="open the drawer")

    address   openpi://HOST:PORT, or a URL that begins with ws:// or wss://
    names     KEY=NAME, a line for each key that the server takes: the name of an image or state of `act`, or `text` for the
              instruction. Several lines of one key join their states. A key `images/X` is the member X of a map `images`
    timeout   seconds that a call may take, connecting included
    api_key   sent as `Authorization: Api-Key ...`

    metadata  what the server says of its policy when a connection begins: a dict, empty at many servers

    A connection that was lost, or that the server ended with an error, is made again by the next call. Threads take turns.
    Errors: UsageError, Disconnected, Timeout, Incompatible.
    """

    def __init__(self, address: str, names: Sequence[str], *, timeout: float = 10.0, api_key: str = "") -> None:
        if not timeout > 0:
            raise UsageError("timeout", "seconds above 0", str(timeout))
        scheme, _, rest = address.partition("://")
        if scheme not in ("openpi", "ws", "wss") or not rest:
            raise UsageError("address", "openpi://HOST:PORT, ws://... or wss://...", address)
        self.address, self.timeout = address, timeout
        self._url = f"ws://{rest}" if scheme == "openpi" else address
        self._names = pairs_of(names)
        self._headers = {"Authorization": f"Api-Key {api_key}"} if api_key else None
        self._lock = threading.Lock()
        self._connection: Any = None
        self._is_closed = False
        self.metadata: Dict[str, Any] = {}
        with self._lock:
            self._connected(time.monotonic() + timeout)

    @property
    def takes_seeds(self) -> bool:
        """Whether a chunk can be asked for again: `vla serve` reads a seed, the protocol itself has none."""
        return str(self.metadata.get("server", "")).startswith("vla.cpp ")

    def act(
        self,
        *,
        images: Mapping[str, Any],
        state: Mapping[str, Any],
        text: str,
        seed: Optional[int] = None,
        timeout: Optional[float] = None,
    ) -> Chunk:
        """One observation in, one action chunk out, in the units of the server.

        images   frames by name: uint8 (height, width, 3) RGB, or a Pillow image
        state    vectors by name
        text     the instruction
        seed     of the noise, 0 to 2^63 - 1, where `takes_seeds`
        timeout  seconds, instead of the client's

        Errors: BadObservation, TooLarge, Unsupported (a seed that the server cannot take), Timeout, Disconnected, Incompatible, and
        what `vla serve` refuses as the classes of Client. What another server tells is a VlaError with the last line of it.
        """
        message = self._message(images, state, text)
        until = time.monotonic() + (self.timeout if timeout is None else timeout)
        with self._lock:
            connection = self._connected(until)
            if seed is not None:
                message["vla"] = {"seed": self._checked(seed)}
            try:
                connection.send(pack(message))
                answer = connection.recv(timeout=max(0.0, until - time.monotonic()))
            except Exception as problem:  # a late answer must not be taken for that of the next call
                self._drop()
                raise self._error_of(problem) from problem
            if isinstance(answer, str):
                self._drop()  # the server ends the connection after it
                raise _refusal(self.address, answer)
        return self._chunk_of(unpack(answer, self.address))

    def close(self) -> None:
        """Ends the connection. A second call does nothing."""
        with self._lock:
            self._is_closed = True
            self._drop()

    def _checked(self, seed: int) -> int:
        if not self.takes_seeds:
            raise Unsupported("seed", "a server that takes one, as vla serve does", "one that draws its noise itself")
        if not 0 <= int(seed) < 2**63:
            raise BadObservation("seed", "0 to 2^63 - 1", str(seed))
        return int(seed)

    def _message(self, images: Mapping[str, Any], state: Mapping[str, Any], text: str) -> Dict[str, Any]:
        given: Dict[str, np.ndarray] = {name: _frame(name, image) for name, image in named("images", images)}
        given.update((name, floats(name, values, 1)) for name, values in named("state", state))
        wanted = {name for _, name in self._names} - {TEXT}
        if wanted != set(given) or len(given) != len(images) + len(state):
            raise BadObservation(
                "names", "lines for each of " + ", ".join(sorted(given)), "lines for " + ", ".join(sorted(wanted))
            )
        joined: Dict[str, List[np.ndarray]] = {}
        for key, name in self._names:
            if name != TEXT:
                joined.setdefault(key, []).append(given[name])
        message: Dict[str, Any] = {}
        for key, parts in joined.items():
            owner, last = message, key
            if key.startswith("images/"):
                last = key[len("images/") :]
                owner = message.setdefault("images", {})
            owner[last] = parts[0] if len(parts) == 1 else np.concatenate(parts)
        message.update((key, text) for key, name in self._names if name == TEXT)
        return message

    def _connected(self, until: float) -> Any:
        if self._is_closed:
            raise Disconnected(self.address, "an open client", "one that was closed")
        if self._connection is None:
            try:
                self._connection = connect(
                    self._url, compression=None, max_size=MAX_ANSWER, additional_headers=self._headers,
                    open_timeout=max(0.001, until - time.monotonic()), ping_interval=None, proxy=None,
                ).__enter__()  # fmt: skip
                greeting = self._connection.recv(timeout=max(0.0, until - time.monotonic()))
            except Exception as problem:
                self._drop()
                raise self._error_of(problem) from problem
            metadata = None if isinstance(greeting, str) else unpack(greeting, self.address)
            if not isinstance(metadata, dict):
                self._drop()
                raise Incompatible(self.address, "the metadata of an openpi server", f"{type(metadata).__name__}")
            self.metadata = metadata
        return self._connection

    def _drop(self) -> None:
        connection, self._connection = self._connection, None
        if connection is not None:
            with contextlib.suppress(OSError):  # no closing handshake: a server that computes would let us wait for it
                connection.socket.shutdown(socket.SHUT_RDWR)

    def _error_of(self, problem: Exception) -> VlaError:
        if isinstance(problem, TimeoutError):
            return Timeout(self.address, "an answer in time", "none", "give more time, or see whether the server is up")
        if isinstance(problem, (OSError, WebSocketException)):
            return Disconnected(self.address, "an openpi server", str(problem) or type(problem).__name__)
        raise problem

    def _chunk_of(self, answer: Any) -> Chunk:
        if isinstance(answer, dict) and answer.get("type") == "error":  # of servers that keep the connection
            raise _refusal(self.address, str(answer.get("message", "")))
        reply = answer if isinstance(answer, dict) else {"actions": answer}
        actions = reply.get("actions")
        if not isinstance(actions, np.ndarray) or actions.ndim != 2 or actions.dtype.kind != "f":
            found = (
                f"{actions.dtype} {actions.shape}"
                if isinstance(actions, np.ndarray)
                else ", ".join(map(str, reply)) or "nothing"
            )
            raise Incompatible(self.address, "`actions`, floats (horizon, d_action)", found)
        try:
            return self._chunk(actions.astype(np.float32), reply)
        except (TypeError, ValueError, AttributeError) as problem:
            raise Incompatible(self.address, "numbers and texts beside `actions`", str(problem)) from None

    def _chunk(self, actions: np.ndarray, reply: Mapping[str, Any]) -> Chunk:
        server, model = reply.get("server_timing", {}), reply.get("policy_timing", {})
        times = {"infer": model.get("infer_ms", server.get("infer_ms"))}
        return Chunk(
            actions=actions,
            names=tuple(map(str, self.metadata.get("action_names", ()))),
            rate_hz=float(self.metadata.get("control_hz", 0.0)),
            bundle=BundleInfo(self.name, "", self.identity, ""),
            timing={name: float(ms) for name, ms in times.items() if ms is not None},
            queue_ms=float(server.get("queue_ms", 0.0)),
            seed=None if reply.get("seed") is None else int(reply["seed"]),
            notes=tuple(map(str, reply.get("notes", ()))),
        )

    @property
    def name(self) -> str:
        """Of the policy's bundle where the server tells it, else the server's address."""
        return str(self.metadata.get("bundle", self.address))

    @property
    def identity(self) -> str:
        """The checksum of the weights where the server tells it, else its address."""
        return str(self.metadata.get("checksum", self.address))


def pairs_of(lines: Sequence[str]) -> List[Tuple[str, str]]:
    """Lines KEY=NAME in two. Errors: UsageError."""
    pairs = [(key, name) for key, _, name in (line.partition("=") for line in lines)]
    if not pairs or not all(key and name for key, name in pairs):
        raise UsageError(
            "names", "lines KEY=NAME, e.g. observation/image=top and prompt=text", ", ".join(lines) or "none"
        )
    return pairs


def _frame(name: str, image: Any) -> np.ndarray:
    if not isinstance(image, np.ndarray) and not is_pillow(image):
        raise BadObservation(name, "a uint8 array (height, width, 3) or a Pillow image", type(image).__name__)
    return np.asarray(image_arg(name, image)[1])


def pack(value: Any) -> bytes:
    """A message with NumPy arrays in it."""
    return msgpack.packb(value, default=_packed)


def _packed(value: Any) -> Any:
    """An array as openpi's own client writes it."""
    return {b"__ndarray__": True, b"data": value.tobytes(), b"dtype": value.dtype.str, b"shape": value.shape}


def _array(value: Dict[Any, Any]) -> Any:
    """The array that a map stands for, in the layout of openpi or of msgpack-numpy, keys as bytes or text; else the map."""
    fields = {key.decode("utf-8", "replace") if isinstance(key, bytes) else key: item for key, item in value.items()}
    if not {"__ndarray__", "__npgeneric__", "nd"} & set(fields):
        return value
    dtype = np.dtype(str(fields.get("dtype", fields.get("type"))))
    if dtype.kind not in "biufU":
        raise ValueError(f"an array of {dtype}")
    if "__npgeneric__" in fields:
        return fields["data"]
    shape = fields.get("shape", ())
    return np.frombuffer(fields["data"], dtype).reshape(shape) if shape else np.frombuffer(fields["data"], dtype, 1)[0]


def unpack(data: bytes, address: str) -> Any:
    """A message, whose arrays are those of `pack` or of the package msgpack-numpy; `address` is where it came from. Errors: Incompatible."""
    try:
        return msgpack.unpackb(data, object_hook=_array, strict_map_key=False)
    except (ValueError, TypeError, KeyError, RecursionError, msgpack.UnpackException) as problem:
        raise Incompatible(address, "msgpack with NumPy arrays", f"other bytes ({problem})") from None


def _refusal(address: str, text: str) -> VlaError:
    """`vla serve` puts its code first; others send a traceback, whose last line says what it was."""
    code, _, rest = text.partition(": ")
    if code.replace("_", "").isalpha() and code.islower():
        return error_of(code, address, found=rest)
    lines = text.strip().splitlines()
    return VlaError(address, found=lines[-1] if lines else "an error without a word")

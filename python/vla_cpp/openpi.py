# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""A policy at any server that speaks openpi's protocol: msgpack over WebSocket. Needs the extra `openpi`."""

from __future__ import annotations

import math
import re
import socket
import threading
import time
from contextlib import contextmanager
from typing import Any, Dict, Iterator, List, Mapping, NamedTuple, Optional, Sequence, Tuple

import numpy as np

from .answer import MAX_ANSWER, checked
from .chunk import Chunk
from .errors import BadObservation, Disconnected, Incompatible, Timeout, Unsupported, UsageError, VlaError, error_of
from .handle import Handle
from .msgpack_message import pack, unpack
from .observation import floats, image_arg, is_pillow, named
from .printable import printable
from .spec import BundleInfo
from .websocket import WebSocket, WebSocketException

MAX_RATE_HZ = 1e6
_CODE = re.compile("[a-z_]{1,32}")
TEXT = "text"  # NAME in a line KEY=NAME whose key holds the instruction


class OpenpiClient(Handle):
    """A client of an openpi policy server, or of `vla serve --openpi`.

        names = ["observation/image=top", "observation/wrist_image=wrist", "observation/state=arm", "prompt=text"]
        with OpenpiClient("openpi://127.0.0.1:8000", names) as policy:
            chunk = policy.act(images={"top": frame, "wrist": other}, state={"arm": q}, text="open the drawer")

    address   openpi://HOST:PORT, or a URL that begins with ws:// or wss://
    names     one text KEY=NAME for each key that the server expects: NAME is an image or state of `act`, or `text` for the
              instruction. Several lines with the same key concatenate their states. The key `images/X` is the member X of a map `images`
    timeout   seconds that a call may take, connecting included
    api_key   sent as `Authorization: Api-Key ...`

    metadata  the server's description of its policy, sent when a connection begins: a dict, empty for many servers

    After a lost connection, or an error with which the server ended it, the next call reconnects, and raises Incompatible if the
    server then has another policy. Threads take turns.
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
        self._headers = {"Authorization": f"Api-Key {api_key}"} if api_key else {}
        self._lock = threading.Lock()
        self._connection: Optional[WebSocket] = None
        self._is_closed = False
        self._said: Optional[_Said] = None
        self._shape: Optional[Tuple[int, int]] = None  # of every chunk: from the metadata, or else from the first chunk
        self.metadata: Dict[str, Any] = {}
        until = time.monotonic() + timeout
        with self._turn(until):
            self._connected(until)

    @property
    def takes_seeds(self) -> bool:
        """Whether a chunk can be reproduced from a seed: `vla serve` accepts a seed, openpi's protocol has none."""
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
        """One observation in, one action chunk out, in the units that the server uses.

        images   frames by name: uint8 (height, width, 3) RGB, or a Pillow image
        state    vectors by name
        text     the instruction
        seed     of the noise, 0 to 2^63 - 1, where `takes_seeds`
        timeout  seconds, instead of the client's

        Errors: BadObservation, TooLarge, Unsupported (a seed for a server without seeds), Timeout, Disconnected, Incompatible; for
        `vla serve` also the server's errors, with the same classes as in Client. An error of another server is a VlaError with the last
        line of its text.
        """
        message = self._message(images, state, text)
        until = time.monotonic() + (self.timeout if timeout is None else timeout)
        with self._turn(until):
            connection = self._connected(until)
            if seed is not None:
                message["vla"] = {"seed": self._checked(seed)}
            try:
                connection.send(pack(message), until)
                answer = connection.receive(until)
            except Exception as problem:  # the next call must not receive the late answer of this one
                self._drop()
                raise self._error_of(problem) from problem
            if isinstance(answer, str):
                self._drop()  # the server closes the connection after an error text
                raise _refusal(self.address, answer)
            return self._chunk_of(unpack(answer, self.address, is_answer=True), seed)

    def close(self) -> None:
        """Closes the connection. A second call does nothing."""
        with self._lock:
            self._is_closed = True
            self._drop()

    @contextmanager
    def _turn(self, until: float) -> Iterator[None]:
        if not self._lock.acquire(timeout=max(0.0, until - time.monotonic())):
            raise Timeout(self.address, "a turn of this client in time", "none", "threads that act at once need a client each")
        try:
            yield
        finally:
            self._lock.release()

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

    def _connected(self, until: float) -> WebSocket:
        if self._is_closed:
            raise Disconnected(self.address, "an open client", "one that was closed")
        if self._connection is not None and not self._connection.is_silent():
            self._drop()  # the connection was lost, or holds a message that would be taken for the next answer
        if self._connection is None:
            try:
                self._connection = WebSocket(self._url, self._headers, MAX_ANSWER, until)
                greeting = self._connection.receive(until)
                self._greet(greeting)
            except Exception as problem:
                self._drop()
                raise self._error_of(problem) from problem
        return self._connection

    def _greet(self, greeting: Any) -> None:
        """Reads the metadata. Errors: Incompatible, also if the policy differs from the one of the previous connection."""
        metadata = None if isinstance(greeting, str) else unpack(greeting, self.address, is_answer=True)
        if not isinstance(metadata, dict):
            raise Incompatible(self.address, "the metadata of an openpi server", type(metadata).__name__)
        said = _said(self.address, metadata)
        if self._said is not None and self._said != said:
            raise Incompatible(self.address, f"the policy as before: {self._said}", str(said), "make a new OpenpiClient")
        self.metadata, self._said, self._shape = metadata, said, said.shape or self._shape

    def _drop(self) -> None:
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()

    def _error_of(self, problem: Exception) -> Exception:
        if isinstance(problem, (TimeoutError, socket.timeout)):
            return Timeout(self.address, "an answer in time", "none", "give more time, or see whether the server is up")
        if isinstance(problem, (OSError, WebSocketException)):
            return Disconnected(self.address, "an openpi server", printable(str(problem)) or type(problem).__name__)
        return problem

    def _chunk_of(self, answer: Any, seed: Optional[int]) -> Chunk:
        if isinstance(answer, dict) and answer.get("type") == "error":  # some servers keep the connection after an error
            raise _refusal(self.address, str(answer.get("message", "")))
        reply = answer if isinstance(answer, dict) else {"actions": answer}
        actions = reply.get("actions")
        if not isinstance(actions, np.ndarray) or actions.ndim != 2 or actions.dtype.kind != "f" or not actions.size:
            found = (
                f"{actions.dtype} {actions.shape}"
                if isinstance(actions, np.ndarray)
                else printable(", ".join(map(str, reply))) or "nothing"
            )
            raise Incompatible(self.address, "`actions`, floats (horizon, d_action)", found)
        with np.errstate(over="ignore"):  # an overflow gives infinity, which `checked` refuses
            chunk = self._chunk(actions.astype(np.float32), reply)
        shape, width = chunk.actions.shape, chunk.actions.shape[1]
        facts = [("shape", self._shape or shape, shape), ("number of columns", len(chunk.names) or width, width)]
        if seed is not None and chunk.seed is not None:
            facts.append(("seed", int(seed), chunk.seed))
        chunk, self._shape = checked(self.address, chunk, facts), shape
        return chunk

    def _chunk(self, actions: np.ndarray, reply: Mapping[str, Any]) -> Chunk:
        server, model = (_part(self.address, reply, key, dict, {}) for key in ("server_timing", "policy_timing"))
        infer = _number(self.address, model, "infer_ms", _number(self.address, server, "infer_ms", None))
        notes = _part(self.address, reply, "notes", list, [])
        return Chunk(
            actions=actions,
            names=self._said.names,
            rate_hz=self._said.rate_hz,
            bundle=BundleInfo(self.name, "", self.identity, ""),
            timing={} if infer is None else {"infer": infer},
            queue_ms=_number(self.address, server, "queue_ms", 0.0),
            seed=_part(self.address, reply, "seed", int, None),
            notes=tuple(str(note) for note in notes),
        )

    @property
    def name(self) -> str:
        """Name of the policy's bundle if the server states it, else the server's address."""
        return str(self.metadata.get("bundle", self.address))

    @property
    def identity(self) -> str:
        """Checksum of the weights if the server states it, else the server's address."""
        return str(self.metadata.get("checksum", self.address))


def pairs_of(lines: Sequence[str]) -> List[Tuple[str, str]]:
    """Lines KEY=NAME as pairs (KEY, NAME). Errors: UsageError."""
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


class _Said(NamedTuple):
    """The policy's description in a server's metadata, which its answers must match. Unstated: shape is None, names are empty."""

    checksum: str
    names: Tuple[str, ...]
    shape: Optional[Tuple[int, int]]
    rate_hz: float


def _said(address: str, metadata: Mapping[str, Any]) -> _Said:
    """Reads the policy's description in the metadata. Errors: Incompatible."""
    names = _part(address, metadata, "action_names", list, [])
    if not all(isinstance(name, str) for name in names):
        raise Incompatible(address, "texts as `action_names`", "others")
    horizon, width = (_part(address, metadata, key, int, None) for key in ("action_horizon", "action_dim"))
    rate_hz = _number(address, metadata, "control_hz", 0.0)
    if not 0 <= rate_hz <= MAX_RATE_HZ:
        raise Incompatible(address, f"`control_hz` from 0 to {MAX_RATE_HZ:g}", f"{rate_hz:g}")
    shape = None if horizon is None or width is None else (horizon, width)
    return _Said(str(metadata.get("checksum", "")), tuple(names), shape, rate_hz)


def _part(address: str, owner: Mapping[str, Any], key: str, kind: type, default: Any) -> Any:
    """A member of an answer, checked to be of type `kind`; `default` if it is absent. Errors: Incompatible."""
    value = owner.get(key)
    if value is None:
        return default
    if not isinstance(value, kind) or isinstance(value, bool):
        raise Incompatible(address, f"`{key}` of the type {kind.__name__} beside `actions`", type(value).__name__)
    return value


def _number(address: str, owner: Mapping[str, Any], key: str, default: Optional[float]) -> Any:
    """A finite number of an answer; `default` if it is absent. Errors: Incompatible."""
    value = owner.get(key)
    if value is None:
        return default
    if isinstance(value, bool) or not isinstance(value, (int, float, np.number)) or not math.isfinite(value):
        raise Incompatible(address, f"a finite number as `{key}`", printable(repr(value)))
    return float(value)


def _refusal(address: str, text: str) -> VlaError:
    """The exception for an error text. `vla serve` begins it with an error code; other servers send a traceback, whose last line
    names the error."""
    code, _, rest = text.partition(": ")
    if _CODE.fullmatch(code):
        return error_of(code, address, found=printable(rest))
    lines = text.strip().splitlines()
    return VlaError(address, found=printable(lines[-1]) if lines else "an error without a word")

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Reads recordings of `vla serve --record`. src/observe/recording.h describes the file."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO, Dict, Iterator, Optional, Tuple

import numpy as np
import xxhash
from google.protobuf.message import DecodeError

from . import wire
from .chunk import Chunk
from .errors import BadRequest, IoError, VlaError
from .observation import place, robot_of
from .spec import Spec

FILE = "requests.vlarec"
_LATEST_NS = 4_102_444_800 * 10**9  # the year 2100; a later time of receipt is damage
_LONGEST_MS = 1e9  # most milliseconds from receipt to answer
_MAGIC = b"VLAREC2\n"
_HEAD, _SEAL = struct.Struct("<4sIIIQQ"), struct.Struct("<Q")


@dataclass(frozen=True)
class Record:
    """A request and its answer as bytes of the wire protocol.

    index        number of the record, from 1; 0 is the server's description
    client       id of the connection
    received_ns  when the request was received, in nanoseconds since 1970
    """

    index: int
    client: int
    received_ns: int
    request: bytes
    response: bytes


class Recording:
    """Iterates over the records of a recording. Errors: IoError (no such file), BadRequest (damaged, with the place)."""

    def __init__(self, folder: Path) -> None:
        self.path = Path(folder) / FILE
        self.is_whole = False  # whether reading has reached the end mark that the server wrote
        if not self.path.is_file():  # opening a pipe would wait
            raise IoError(str(self.path), "a recording of vla serve --record", "no file that can be read")
        for record in self._records():
            self.spec = self._described(record)
            return
        raise self._damaged(0, 8, "the server's description", "the end of the file")

    def __iter__(self) -> Iterator[Record]:
        """Every record after the description, in the order of the answers."""
        records = self._records()
        next(records)
        return records

    def _records(self) -> Iterator[Record]:
        try:
            size = self.path.stat().st_size
            with open(self.path, "rb") as file:
                if file.read(len(_MAGIC)) != _MAGIC:
                    raise self._damaged(0, 0, "VLAREC2, the mark of a recording", "other bytes")
                index, record = 0, self._next(file, 0, size)
                while record is not None:
                    yield record
                    index += 1
                    record = self._next(file, index, size)
        except OSError as problem:
            raise IoError(str(self.path), "a file that can be read", str(problem)) from None

    def _next(self, file: BinaryIO, index: int, size: int) -> Optional[Record]:
        at = file.tell()
        if at == size:
            return None
        head = file.read(_HEAD.size)
        seal = file.read(_SEAL.size)
        if len(seal) < _SEAL.size:
            raise self._damaged(index, at, "the head of a record", "the end of the file")
        mark, found_index, n_in, n_out, client, received_ns = _HEAD.unpack(head)
        if mark not in (b"VREC", b"VEND") or found_index != index:
            raise self._damaged(index, at, f"record {index}", "other bytes")
        if n_in + n_out > size - file.tell():
            raise self._damaged(index, at, f"{n_in + n_out} bytes", "the end of the file")
        request, response = file.read(n_in), file.read(n_out)
        digest = 0
        for part in (head, request, response):
            digest = xxhash.xxh3_64_intdigest(part, digest)
        if _SEAL.pack(digest) != seal:
            raise self._damaged(index, at, "bytes of the checksum that was recorded", "bytes of another")
        if received_ns >= _LATEST_NS:
            raise self._damaged(index, at, "a time before the year 2100", f"{received_ns} ns since 1970")
        if mark == b"VEND":
            if file.tell() != size:
                raise self._damaged(index, file.tell(), "the end of the file", f"{size - file.tell()} bytes more")
            self.is_whole = True
            return None
        return Record(index, client, received_ns, request, response)

    def _described(self, record: Record) -> Spec:
        try:
            return wire.spec_of(wire.MESSAGES["Description"].FromString(record.request))
        except DecodeError:
            raise self._damaged(0, len(_MAGIC), "the server's description", "other bytes") from None

    def _damaged(self, index: int, at: int, expected: str, found: str) -> VlaError:
        hint = f"--first {index - 1} takes what comes before it" if index > 1 else ""
        return BadRequest(f"{self.path}: record {index} at byte {at}", expected, found, hint)


@dataclass(frozen=True, eq=False)
class RecordedAct:
    """An observation and the server's answer.

    spec    spec of the observed robot
    images  by full name: (kind, data), "jpeg" or "png" with the file's bytes, or "rgb" with uint8 (height, width, 3);
            views that the robot does not have are left out
    states  by full name, float32 in world units
    answer  the Chunk, or the VlaError if there is none
    """

    record: Record
    spec: Spec
    images: Dict[str, Tuple[str, Any]]
    states: Dict[str, np.ndarray]
    text: str
    answer: Any  # Chunk or VlaError

    @property
    def ready_ns(self) -> int:
        """When the answer was ready, in nanoseconds since 1970; the time of receipt if it is an error."""
        took_ms = _took_ms(self.answer) if isinstance(self.answer, Chunk) else 0
        return self.record.received_ns + int(took_ms * 1e6)


def _took_ms(chunk: Chunk) -> float:
    return chunk.queue_ms + sum(chunk.timing.values())


def acts_of(recording: Recording, first: Optional[int] = None) -> Iterator[RecordedAct]:
    """The acts among the first `first` records, or among all. A refused act has no images and states, since they may be the invalid part.
    Errors: BadRequest (an act and an answer that do not match)."""
    for record in islice(recording, first):
        try:
            request = wire.Request.FromString(record.request)
            response = wire.Response.FromString(record.response)
        except DecodeError:  # a message that is not a request is recorded too, with the error that answered it
            continue
        if request.WhichOneof("kind") != "act":
            continue
        act = request.act
        if response.WhichOneof("kind") != "chunk":
            yield RecordedAct(record, recording.spec, {}, {}, act.text, wire.exception_of(response.error))
            continue
        try:
            yield _answered(record, robot_of(recording.spec, act.embodiment or None), act, wire.chunk_of(response.chunk))
        except (VlaError, ValueError) as problem:
            where = f"{recording.path}: record {record.index}"
            raise BadRequest(where, "an observation that its answer is to", str(problem)) from None


def _answered(record: Record, spec: Spec, act: Any, chunk: Chunk) -> RecordedAct:
    states = {place("state", s.name, spec.states): np.array(s.values, np.float32) for s in act.states}
    widths = {state.name: state.width for state in spec.states}
    if {name: len(values) for name, values in states.items()} != widths or chunk.actions.shape[1] != spec.d_action:
        raise ValueError("states or actions of other widths")
    if not 0 <= _took_ms(chunk) < _LONGEST_MS:
        raise ValueError(f"stages that took {_took_ms(chunk)} ms")
    images = {place("view", v.name, spec.views): _image(v) for v in act.views if v.WhichOneof("image") != "absent"}
    return RecordedAct(record, spec, images, states, act.text, chunk)


def _image(view: Any) -> Tuple[str, Any]:
    kind = view.WhichOneof("image")
    if kind != "rgb":
        return kind, getattr(view, kind)
    return kind, np.frombuffer(view.rgb.rows, np.uint8).reshape(view.rgb.height, view.rgb.width, 3)

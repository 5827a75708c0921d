# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Writes MCAP files, for Foxglove, Lichtblick and others: pictures as `foxglove.CompressedImage`, everything else as JSON."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Dict, Iterable, Mapping, Sequence

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2
from mcap.writer import Writer

from ..chunk import Chunk
from ..errors import VlaError
from ..recording import RecordedAct
from ..spec import Spec
from .common import column_names, picture_file

_OBJECT = json.dumps({"type": "object"}).encode()


def _image_schema() -> descriptor_pb2.FileDescriptorSet:
    """The schema of Foxglove's CompressedImage with its imports. A reader identifies it by name and takes the fields from this schema."""
    file = descriptor_pb2.FileDescriptorProto(name="foxglove/CompressedImage.proto", package="foxglove", syntax="proto3")
    file.dependency.append("google/protobuf/timestamp.proto")
    message = file.message_type.add(name="CompressedImage")
    kinds = descriptor_pb2.FieldDescriptorProto
    message.field.add(name="timestamp", number=1, type=kinds.TYPE_MESSAGE, label=1, type_name=".google.protobuf.Timestamp")
    message.field.add(name="frame_id", number=4, type=kinds.TYPE_STRING, label=1)
    message.field.add(name="data", number=2, type=kinds.TYPE_BYTES, label=1)
    message.field.add(name="format", number=3, type=kinds.TYPE_STRING, label=1)
    timestamp = descriptor_pb2.FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(timestamp)
    return descriptor_pb2.FileDescriptorSet(file=[timestamp, file])


def _image_class(schema: descriptor_pb2.FileDescriptorSet) -> Any:
    pool = descriptor_pool.DescriptorPool()
    for file in schema.file:
        pool.AddSerializedFile(file.SerializeToString())
    descriptor = pool.FindMessageTypeByName("foxglove.CompressedImage")
    if hasattr(message_factory, "GetMessageClass"):
        return message_factory.GetMessageClass(descriptor)
    return message_factory.MessageFactory(pool).GetPrototype(descriptor)  # protobuf before 4.22


class _File:
    """The topics of an MCAP file; each is made with its first message."""

    def __init__(self, writer: Writer) -> None:
        schema = _image_schema()
        self._writer, self._channels = writer, {}  # type: Writer, Dict[str, int]
        self._image = _image_class(schema)
        self._image_schema = writer.register_schema("foxglove.CompressedImage", "protobuf", schema.SerializeToString())
        self._json_schema = writer.register_schema("vla.json", "jsonschema", _OBJECT)

    def picture(self, topic: str, at_ns: int, view: str, kind: str, data: bytes) -> None:
        message = self._image(frame_id=view, format=kind, data=data)
        message.timestamp.seconds, message.timestamp.nanos = divmod(at_ns, 10**9)
        self._add(topic, "protobuf", self._image_schema, at_ns, message.SerializeToString())

    def values(self, topic: str, at_ns: int, values: Mapping[str, Any]) -> None:
        self._add(topic, "json", self._json_schema, at_ns, json.dumps(values).encode())

    def _add(self, topic: str, encoding: str, schema: int, at_ns: int, data: bytes) -> None:
        if topic not in self._channels:
            self._channels[topic] = self._writer.register_channel(topic, encoding, schema)
        self._writer.add_message(self._channels[topic], at_ns, data, at_ns)


def write_mcap(path: Path, spec: Spec, acts: Iterable[RecordedAct]) -> None:
    with open(path, "wb") as stream:
        writer = Writer(stream)
        writer.start(profile="", library="vla.cpp")
        bundle = {"name": spec.bundle.name, "arch": spec.bundle.arch, "checksum": spec.bundle.checksum, "source": spec.bundle.source}
        writer.add_metadata("vla.bundle", bundle)
        file = _File(writer)
        for act in acts:
            _write_act(file, act)
        writer.finish()


def _write_act(file: _File, act: RecordedAct) -> None:
    at = act.record.received_ns
    for view, image in act.images.items():
        file.picture(_topic(view), at, view, *picture_file(image))
    names = {state.name: state.names for state in act.spec.states}
    for state, values in act.states.items():
        file.values(_topic(state), at, _by_name(names[state], values))
    file.values("/instruction", at, {"text": act.text})
    answer = act.answer
    if isinstance(answer, VlaError):
        texts = {name: getattr(answer, name) for name in ("code", "where", "expected", "found", "hint")}
        file.values("/error", at, texts)
    else:
        file.values("/action", act.ready_ns, _action(answer))
        file.values("/timing_ms", act.ready_ns, {"queue": answer.queue_ms, **answer.timing})


def _action(chunk: Chunk) -> Dict[str, Any]:
    rows = [_by_name(chunk.names, row) for row in chunk.actions]
    return {"rate_hz": chunk.rate_hz, "seed": chunk.seed, "capture_time_ns": chunk.capture_time_ns, "notes": chunk.notes, "rows": rows}


def _by_name(names: Sequence[str], values: np.ndarray) -> Dict[str, float]:
    """The values by name. JSON writes each with enough digits that reading returns the same float32 to the bit."""
    return dict(zip(column_names(names, len(values)), values.tolist()))


def _topic(name: str) -> str:
    return "/" + name.replace(".", "/")

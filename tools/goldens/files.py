# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Checkpoint files written by numpy alone: JSON, safetensors and what torch.save writes.  The same values give the same bytes."""

import json
import math
import struct
import zipfile
from pathlib import Path

import numpy as np

from .draw import bfloat16

NUMPY = {"<f4": "F32", "<f2": "F16", "<f8": "F64", "<i8": "I64", "<u2": "BF16"}
ITEM = {"F32": 4, "BF16": 2}  # bytes of the types that large files have
STORAGES = {"F32": "FloatStorage", "F16": "HalfStorage", "BF16": "BFloat16Storage", "I64": "LongStorage"}


def write_json(path, value, indent=None):
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value, indent=indent) + "\n", encoding="utf-8")


def bfloat16_bits(values):
    """The upper halves of float32 numbers, which must be exact in bfloat16."""
    values = np.ascontiguousarray(values, np.float32)
    assert np.array_equal(bfloat16(values), values)
    return (values.view(np.uint32) >> 16).astype("<u2")


def write_safetensors(path, tensors, metadata=None):
    """tensors: name -> array, or (dtype name, array); uint16 stands for bfloat16."""
    stored = {k: v if isinstance(v, tuple) else (NUMPY[v.dtype.str], v) for k, v in tensors.items()}
    write_stream(path, {k: (d, v.shape) for k, (d, v) in stored.items()}, lambda name: stored[name][1], metadata)


def write_stream(path, declared, value, metadata=None):
    """declared: name -> (dtype name, shape).  value(name) makes one tensor at a time, since the large ones fill the memory."""
    header, offset = {} if metadata is None else {"__metadata__": metadata}, 0
    for name, (dtype, shape) in declared.items():
        end = offset + (ITEM.get(dtype) or value(name).itemsize) * math.prod(shape)
        header[name] = {"dtype": dtype, "shape": list(shape), "data_offsets": [offset, end]}
        offset = end
    text = json.dumps(header).encode()
    with open(path, "wb") as file:
        file.write(len(text).to_bytes(8, "little") + text)
        for name in declared:
            file.write(np.ascontiguousarray(value(name)).tobytes())


# --- what torch.save writes: a pickle in an archive, with one stored entry for each storage -------------------------


class Name:
    """A global, "module name"."""

    def __init__(self, name):
        self.module, self.name = name.split(" ")


class Call:
    """What `function(*arguments)` leaves in a pickle."""

    def __init__(self, function, *arguments):
        self.function, self.arguments = Name(function), arguments


class Persistent:
    def __init__(self, *name):
        self.name = name


class Raw(bytes):
    """Opcodes as they are."""


def emit(value):
    if isinstance(value, Raw):
        return bytes(value)
    if value is None or isinstance(value, bool):
        return {None: b"N", True: b"\x88", False: b"\x89"}[value]
    if isinstance(value, int):
        return b"\x8a\x08" + struct.pack("<q", value)
    if isinstance(value, float):
        return b"G" + struct.pack(">d", value)
    if isinstance(value, str):
        data = value.encode("utf-8", "surrogatepass")
        return b"X" + struct.pack("<I", len(data)) + data
    if isinstance(value, tuple):
        return b"(" + b"".join(map(emit, value)) + b"t"
    if isinstance(value, list):
        return b"](" + b"".join(map(emit, value)) + b"e"
    if isinstance(value, dict):
        return b"}(" + b"".join(emit(key) + emit(item) for key, item in value.items()) + b"u"
    if isinstance(value, Name):
        return f"c{value.module}\n{value.name}\n".encode()
    if isinstance(value, Persistent):
        return emit(value.name) + b"Q"
    return emit(value.function) + emit(tuple(value.arguments)) + b"R"


def pickled(value):
    return b"\x80\x02" + emit(value) + b"."


def tensor(key, shape, kind="F32", first=0, stride=None, n_element=None):
    """The pickle's form of a tensor that begins at element `first` of storage `key`."""
    if stride is None:
        stride = tuple(math.prod(shape[i + 1 :]) for i in range(len(shape)))
    name = Name("torch " + STORAGES.get(kind, kind))
    storage = Persistent("storage", name, key, "cpu", first + math.prod(shape) if n_element is None else n_element)
    return Call("torch._utils _rebuild_tensor_v2", storage, first, tuple(shape), stride, False, Call("collections OrderedDict"))


def state_dict(tensors):
    """The pickle's form of named arrays, and the bytes of their storages."""
    values, data = {}, {}
    for i, (name, array) in enumerate(tensors.items()):
        values[name] = tensor(str(i), array.shape, NUMPY[array.dtype.str])
        data[str(i)] = array.tobytes()
    return values, data


def write_archive(path, content, data, root="step", byteorder=b"little", compression=zipfile.ZIP_STORED):
    """content: a value to pickle, or bytes.  data: storages by key."""
    with zipfile.ZipFile(str(path), "w", compression) as archive:
        entries = {"data.pkl": content if isinstance(content, bytes) else pickled(content), "byteorder": byteorder,
                   **{f"data/{key}": stored for key, stored in data.items()}, "version": b"3\n"}
        for name, stored in entries.items():
            archive.writestr(zipfile.ZipInfo(f"{root}/{name}"), stored, compression)  # with the date of 1980, always
    return str(path)


def write_torch(path, tensors, member="module", **others):
    values, data = state_dict(tensors)
    return write_archive(path, {**others, member: values}, data)

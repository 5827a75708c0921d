# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Files as torch.save writes them, made without torch: a pickle put together opcode by opcode, in an archive of stored entries."""

import struct
import zipfile

import numpy as np

STORAGES = {"F32": ("FloatStorage", 4), "F16": ("HalfStorage", 2), "BF16": ("BFloat16Storage", 2), "I64": ("LongStorage", 8)}


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
        return "c{}\n{}\n".format(value.module, value.name).encode()
    if isinstance(value, Persistent):
        return emit(value.name) + b"Q"
    return emit(value.function) + emit(tuple(value.arguments)) + b"R"


def pickled(value):
    return b"\x80\x02" + emit(value) + b"."


def tensor(key, shape, kind="F32", first=0, stride=None, n_element=None):
    n = int(np.prod(shape, dtype=np.int64))
    if stride is None:
        stride = tuple(int(np.prod(shape[i + 1 :], dtype=np.int64)) for i in range(len(shape)))
    name = Name("torch " + STORAGES[kind][0]) if kind in STORAGES else Name("torch " + kind)
    storage = Persistent("storage", name, key, "cpu", first + n if n_element is None else n_element)
    return Call("torch._utils _rebuild_tensor_v2", storage, first, tuple(shape), stride, False, Call("collections OrderedDict"))


def bf16(values):
    """The upper halves of float32, for numbers that they hold exactly."""
    bits = np.ascontiguousarray(values, np.float32).view(np.uint32)
    assert not (bits & 0xFFFF).any()
    return (bits >> 16).astype("<u2")


def state_dict(tensors):
    """The pickle's form of named arrays (uint16 stands for bfloat16), and the bytes of their storages."""
    kinds = {np.dtype("<f4"): "F32", np.dtype("<f2"): "F16", np.dtype("<u2"): "BF16", np.dtype("<i8"): "I64"}
    values, data = {}, {}
    for i, (name, array) in enumerate(tensors.items()):
        values[name] = tensor(str(i), array.shape, kinds[array.dtype])
        data[str(i)] = array.tobytes()
    return values, data


def write_archive(path, content, data, root="step", byteorder=b"little", compression=zipfile.ZIP_STORED):
    """`content`: a value to pickle, or bytes. `data`: storages by key."""
    with zipfile.ZipFile(str(path), "w", compression) as archive:
        archive.writestr(root + "/data.pkl", content if isinstance(content, bytes) else pickled(content))
        archive.writestr(root + "/byteorder", byteorder)
        for key, stored in data.items():
            archive.writestr("{}/data/{}".format(root, key), stored)
        archive.writestr(root + "/version", b"3\n")
    return str(path)


def write_torch(path, tensors, member="module", **others):
    values, data = state_dict(tensors)
    return write_archive(path, {**others, member: values}, data)

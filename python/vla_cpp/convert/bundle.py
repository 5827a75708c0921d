# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""A streaming writer of bundles (docs/bundle.md) and a reader for tests and tools.

The header describes every tensor before the first byte of data is written, so the file is written in one pass and never held in
memory. It gets its final name after the checksum is written: an existing bundle is complete.
"""

from __future__ import annotations

import mmap
import struct
from contextlib import ExitStack
from typing import BinaryIO, Callable, Dict, List, NamedTuple, Sequence, Tuple

import numpy as np

from ..output import whole_file
from .dtypes import BUNDLE_DTYPES, GGML_TYPES
from .errors import Code, refuse
from .files import missing_extra

ALIGNMENT = 32  # the format's default
BUNDLE_VERSION = 1
CHECKSUM_KEY = "vla.checksum"
CHECKSUM_ZERO = "xxh3:" + "0" * 16
HASH_CHUNK = 8 << 20
# GGUF's type number of each value type, and the struct format of a value.
SCALARS = {"u32": (4, "<I"), "f32": (6, "<f"), "bool": (7, "<?"), "f64": (12, "<d")}
STRING, ARRAY = 8, 9


class Key(NamedTuple):
    """One metadata value. `kind`: u32, f32, f64, bool, string, u32[] or string[]."""

    name: str
    kind: str
    value: object


def keys_by_type(groups: Dict[str, Dict[str, object]]) -> List[Key]:
    """Keys from {type: {name: value}}, in the order of the dicts."""
    return [Key(name, kind, value) for kind, group in groups.items() for name, value in group.items()]


class TensorInfo(NamedTuple):
    """A tensor of the bundle: shape in torch's order of dimensions, dtype f32, bf16, f16, i8 or f64."""

    name: str
    shape: Tuple[int, ...]
    dtype: str

    @property
    def n_bytes(self) -> int:
        return int(np.prod(self.shape, dtype=np.int64)) * BUNDLE_DTYPES[self.dtype].itemsize


def _string(text: str) -> bytes:
    data = text.encode("utf-8")
    return struct.pack("<Q", len(data)) + data


def _value(kind: str, value) -> bytes:
    return _string(value) if kind == "string" else struct.pack(SCALARS[kind][1], value)


def _pack(key: Key) -> bytes:
    base = key.kind[:-2] if key.kind.endswith("[]") else key.kind
    number = STRING if base == "string" else SCALARS[base][0]
    if base == key.kind:
        return _string(key.name) + struct.pack("<I", number) + _value(base, key.value)
    head = struct.pack("<IIQ", ARRAY, number, len(key.value))
    return _string(key.name) + head + b"".join(_value(base, item) for item in key.value)


def _padding(size: int) -> bytes:
    return b"\0" * (-size % ALIGNMENT)


def _header(keys: Sequence[Key], tensors: Sequence[TensorInfo]) -> bytes:
    parts = [b"GGUF", struct.pack("<IQQ", 3, len(tensors), len(keys))]
    parts += [_pack(key) for key in keys]
    offset = 0
    for tensor in tensors:
        shape = tensor.shape[::-1]  # GGUF lists the fastest dimension first
        parts.append(_string(tensor.name) + struct.pack("<I{}QIQ".format(len(shape)), len(shape), *shape, GGML_TYPES[tensor.dtype], offset))
        offset += tensor.n_bytes + len(_padding(tensor.n_bytes))
    header = b"".join(parts)
    return header + _padding(len(header))


class BundleWriter:
    """`with BundleWriter(path, keys, tensors) as out:` and then `out.write(name, array)` in the order of `tensors`, whole or in pieces.
    Leaving the block completes the file; an exception removes it. `check`: called with the temporary path of the complete file; its
    exception removes the file too."""

    def __init__(
        self, path: str, keys: Sequence[Key], tensors: Sequence[TensorInfo], check: Callable[[str], None] = lambda _: None
    ) -> None:
        self.path, self.check = path, check
        self.tensors: List[TensorInfo] = list(tensors)
        checksum = Key(CHECKSUM_KEY, "string", CHECKSUM_ZERO)
        # The checksum comes first, so that a search for its key's text finds it before any vocabulary that contains the same text.
        self.header = _header([checksum, *keys], tensors)
        self.n_bytes = len(self.header) + sum(t.n_bytes + len(_padding(t.n_bytes)) for t in self.tensors)
        self.left = 0
        self.next = 0

    def __enter__(self) -> "BundleWriter":
        with ExitStack() as stack:
            self.file: BinaryIO = stack.enter_context(whole_file(self.path))
            self.file.write(self.header)
            self.output = stack.pop_all()
        return self

    def write(self, name: str, data: np.ndarray) -> None:
        if self.left == 0:
            tensor = self.tensors[self.next]
            self.next, self.left = self.next + 1, tensor.n_bytes
        tensor = self.tensors[self.next - 1]
        if name != tensor.name or data.nbytes > self.left or data.dtype != BUNDLE_DTYPES[tensor.dtype]:
            raise AssertionError("{}: {} bytes of {} do not belong to {}".format(name, data.nbytes, data.dtype, tensor))
        self.file.write(np.ascontiguousarray(data).data)
        self.left -= data.nbytes
        if self.left == 0:
            self.file.write(_padding(tensor.n_bytes))

    def __exit__(self, kind, error, trace) -> None:
        if error is not None:
            self.output.__exit__(kind, error, trace)
            return
        with self.output:
            self._finish()
            self.file.flush()
            self.check(self.file.name)

    def _finish(self) -> None:
        if self.left or self.next != len(self.tensors):
            raise AssertionError("{} of {} tensors written, {} bytes missing".format(self.next, len(self.tensors), self.left))
        digits = self.header.index(CHECKSUM_ZERO.encode()) + len("xxh3:")
        digest = file_digest(self.file)
        self.file.seek(digits)
        self.file.write(digest.encode())


def file_digest(file: BinaryIO, digits: int = -1) -> str:
    """XXH3-64 of the file in hex. `digits`: offset of 16 bytes that are hashed as zeros, for a file that contains its own checksum."""
    try:
        import xxhash
    except ImportError:
        raise missing_extra("xxhash")
    state = xxhash.xxh3_64()
    file.seek(0)
    position = 0
    while True:
        block = bytearray(file.read(HASH_CHUNK))
        if not block:
            return state.hexdigest()
        if digits >= 0:
            first, last = max(digits - position, 0), max(min(digits + 16 - position, len(block)), 0)
            block[first:last] = b"0" * max(last - first, 0)
        state.update(bytes(block))
        position += len(block)


def _check_digest(path: str) -> None:
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        # The key is followed by the type (4 bytes), the length (8 bytes) and "xxh3:".
        digits = data.find(CHECKSUM_KEY.encode()) + len(CHECKSUM_KEY) + 4 + 8 + len("xxh3:")
        stated, found = data[digits : digits + 16].decode("latin1"), file_digest(file, digits)
    if found != stated:
        raise refuse(path, "content with checksum xxh3:" + stated, "xxh3:" + found, "the file was damaged or edited", Code.BAD_BUNDLE)


class BundleContent(NamedTuple):
    """A bundle in memory: metadata by key, tensors by name in torch's order of dimensions (bf16 as uint16 bits)."""

    keys: Dict[str, object]
    tensors: Dict[str, np.ndarray]
    dtypes: Dict[str, str]


def read_bundle(path: str) -> BundleContent:
    """Reads a bundle and verifies its checksum. For tests and tools; the runtime has its own bounded reader."""
    try:
        from gguf import GGUFReader
    except ImportError:
        raise missing_extra("gguf")
    _check_digest(path)
    reader = GGUFReader(path)
    keys = {name: field.contents() for name, field in reader.fields.items()}
    names = {number: name for name, number in GGML_TYPES.items()}
    tensors, dtypes = {}, {}
    for tensor in reader.tensors:
        dtypes[tensor.name] = names[int(tensor.tensor_type)]
        shape = tuple(int(dim) for dim in tensor.shape[::-1])
        tensors[tensor.name] = np.asarray(tensor.data).view(BUNDLE_DTYPES[dtypes[tensor.name]]).reshape(shape)
    return BundleContent(keys, tensors, dtypes)

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""A bounded reader of safetensors files (format: 8 bytes header length, JSON header, data).

A checkpoint is untrusted, so every length and offset is compared with the size of the file before it is used.
Data is read in chunks, never mapped as a whole: a conversion needs a few megabytes for a checkpoint of any size.
"""

from __future__ import annotations

import json
import os
from typing import Dict, Iterator, NamedTuple, Tuple

import numpy as np

from ..strict_json import unique_names
from .dtypes import SIZES, STATISTICS
from .errors import refuse
from .files import open_file

# The limit of the format's own library, in bytes; the header of a large checkpoint has less than a megabyte.
MAX_HEADER = 100_000_000
CHUNK_BYTES = 8 << 20
MAX_TENSORS = 50_000  # tensors in a file; the largest policies have a few thousand


class Entry(NamedTuple):
    """One tensor of a file: shape in torch's order of dimensions, offset in bytes from the start of the file."""

    name: str
    dtype: str
    shape: Tuple[int, ...]
    path: str
    offset: int
    n_bytes: int

    def rows(self, first: int, count: int) -> "Entry":
        """The rows from `first` to `first + count`, which must lie within the first dimension; for a tensor that stacks several."""
        row = self.n_bytes // self.shape[0]
        return self._replace(shape=(count, *self.shape[1:]), offset=self.offset + first * row, n_bytes=count * row)

    def chunks(self, chunk_bytes: int = CHUNK_BYTES) -> Iterator[np.ndarray]:
        """The tensor's elements in order, as flat arrays of at most `chunk_bytes` (BF16 as uint16 bits)."""
        kind = STATISTICS[self.dtype]
        left = self.n_bytes // kind.itemsize
        with open_file(self.path) as file:
            file.seek(self.offset)
            while left:
                part = np.fromfile(file, dtype=kind, count=min(left, chunk_bytes // kind.itemsize))
                if part.size == 0:
                    raise refuse("{}: tensor {}".format(self.path, self.name), "{} more elements".format(left), "the end of the file")
                left -= part.size
                yield part


class SafetensorsFile(NamedTuple):
    entries: Dict[str, Entry]
    metadata: Dict[str, str]


def check_count(where: str, n_tensor: int) -> None:
    """Refuses too many tensors, before any memory is used for each. Errors: bad_bundle."""
    if n_tensor > MAX_TENSORS:
        raise refuse(where, "at most {} tensors".format(MAX_TENSORS), str(n_tensor))


def _is_count(value) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 1 << 62


def _read_header(path: str) -> Tuple[dict, int, int]:
    hint = "the file is truncated or not a safetensors file: download or save it again"
    with open_file(path) as file:
        size = os.fstat(file.fileno()).st_size
        length = int.from_bytes(file.read(8), "little")
        if size < 8 or length > min(size - 8, MAX_HEADER):
            raise refuse(path, "a safetensors header inside the file", "a header of {} bytes in a file of {}".format(length, size), hint)
        text = file.read(length)
    check_count(path, text.count(b'"data_offsets"'))
    try:
        header = json.loads(text.decode("utf-8"), object_pairs_hook=unique_names)
    except (ValueError, RecursionError) as error:
        raise refuse(path, "a safetensors header in JSON", str(error)[:200], hint)
    if not isinstance(header, dict):
        raise refuse(path, "a safetensors header that is a JSON object", type(header).__name__, hint)
    return header, 8 + length, size


def _read_entry(path: str, name: str, value, start: int, size: int) -> Entry:
    where = "{}: tensor {}".format(path, name)
    if not isinstance(value, dict) or set(value) != {"dtype", "shape", "data_offsets"}:
        raise refuse(where, "dtype, shape and data_offsets", str(value)[:100])
    dtype, shape, offsets = value["dtype"], value["shape"], value["data_offsets"]
    if not isinstance(dtype, str) or dtype not in SIZES:
        raise refuse(where, "a dtype of the safetensors format", str(dtype)[:100])
    if not isinstance(shape, list) or len(shape) > 8 or not all(_is_count(d) for d in shape):
        raise refuse(where, "a shape of at most 8 counts", str(shape)[:100])
    if not isinstance(offsets, list) or len(offsets) != 2 or not all(_is_count(o) for o in offsets):
        raise refuse(where, "two data offsets", str(offsets)[:100])
    n_bytes = SIZES[dtype]
    for dim in shape:
        n_bytes *= dim
    if offsets[1] - offsets[0] != n_bytes:
        raise refuse(where, "{} bytes for {} of {}".format(n_bytes, shape, dtype), "{} bytes".format(offsets[1] - offsets[0]))
    if start + offsets[1] > size:
        raise refuse(where, "data up to byte {}".format(start + offsets[1]), "a file of {} bytes".format(size), "the file is truncated")
    return Entry(name, dtype, tuple(shape), path, start + offsets[0], n_bytes)


def _check_layout(path: str, entries: Dict[str, Entry], start: int, size: int) -> None:
    """Checks that the data has no gaps and no overlaps, as the format requires."""
    position = start
    for entry in sorted(entries.values(), key=lambda e: (e.offset, e.n_bytes)):
        if entry.offset != position:
            raise refuse("{}: tensor {}".format(path, entry.name), "data at byte {}".format(position), "byte {}".format(entry.offset))
        position += entry.n_bytes
    if position != size:
        raise refuse(path, "a file of {} bytes".format(position), "{} bytes".format(size), "the file is damaged: download or save it again")


def read_safetensors(path: str) -> SafetensorsFile:
    """Reads and checks the header, without tensor data."""
    header, start, size = _read_header(path)
    metadata = header.pop("__metadata__", {})
    if not isinstance(metadata, dict) or not all(isinstance(v, str) for v in metadata.values()):
        raise refuse(path + ": __metadata__", "a JSON object of strings", str(metadata)[:100])
    entries = {name: _read_entry(path, name, value, start, size) for name, value in header.items()}
    _check_layout(path, entries, start, size)
    return SafetensorsFile(entries, metadata)

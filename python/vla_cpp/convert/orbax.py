# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Reads arrays of an Orbax checkpoint, JAX's format: a tree of Zarr arrays, alone or inside an OCDBT database. Uses TensorStore.

Reference: orbax checkpoint/_src/serialization (names of arrays), metadata/tree.py (`_METADATA`).
"""

from __future__ import annotations

import math
import os
from typing import Callable, Dict, Iterator, NamedTuple, Tuple

import numpy as np

from .errors import Code, refuse
from .files import member, read_json
from .safetensors_file import CHUNK_BYTES, check_count

METADATA = "_METADATA"
DATABASE = "manifest.ocdbt"
TYPES = {"float32": "F32", "bfloat16": "BF16", "float16": "F16"}
MAX_ELEMENTS = 1 << 34


class Stored(NamedTuple):
    """An array of the checkpoint. `read` returns float32: the whole array, or the part that an index, a slice or a tuple of indices selects."""

    shape: Tuple[int, ...]
    dtype: str
    read: Callable[..., np.ndarray]


class Computed(NamedTuple):
    """A tensor that is computed from stored arrays. Has the members of an `Entry`; its chunks are float32."""

    name: str
    path: str
    shape: Tuple[int, ...]
    stored: str  # the type of the policy's arrays in the file
    make: Callable[[int, int], np.ndarray]  # (first row, number of rows) -> these rows
    by_rows: bool = False  # whether a few rows cost less than all
    first: int = 0
    dtype: str = "F32"
    has_adapter: bool = False  # whether an adapter is merged into it

    @property
    def n_bytes(self) -> int:
        return 4 * math.prod(self.shape)

    def rows(self, first: int, count: int) -> Computed:
        return self._replace(first=self.first + first, shape=(count, *self.shape[1:]))

    def chunks(self, chunk_bytes: int = CHUNK_BYTES) -> Iterator[np.ndarray]:
        n_row = self.shape[0]
        step = max(1, chunk_bytes * n_row // max(1, self.n_bytes)) if self.by_rows else n_row
        for start in range(0, n_row, step):
            part = np.ascontiguousarray(self.make(self.first + start, min(step, n_row - start)), np.float32).ravel()
            for at in range(0, part.size, chunk_bytes // 4):
                yield part[at : at + chunk_bytes // 4]


def is_orbax(folder: str) -> bool:
    return os.path.isfile(os.path.join(folder, METADATA))


def read_orbax(folder: str) -> Dict[str, Stored]:
    """The arrays by name; slashes separate the levels of the tree. Errors: io, bad_bundle, unsupported."""
    where = os.path.join(folder, METADATA)
    try:
        import tensorstore
    except ImportError:
        raise refuse(folder, "TensorStore, which reads checkpoints of JAX", "no such package", "pip install tensorstore", Code.UNSUPPORTED)
    metadata = read_json(where)
    leaves = member(metadata, "tree_metadata", dict, where)
    check_count(where, len(leaves))
    driver = "zarr3" if metadata.get("use_zarr3") else "zarr"
    arrays = {}
    for leaf in leaves.values():
        keys = leaf.get("key_metadata") if isinstance(leaf, dict) else None
        names = [key.get("key") if isinstance(key, dict) else None for key in keys] if isinstance(keys, list) else []
        if not names or not all(isinstance(name, str) and name and not set(name) & set("/\\\0") and name not in (".", "..") for name in names):
            raise refuse(where, "names of arrays", repr(leaf)[:100])
        arrays["/".join(names)] = _open(tensorstore, folder, driver, ".".join(names))
    return arrays


def _open(tensorstore, folder: str, driver: str, name: str) -> Stored:
    where, root = "{}: array {}".format(folder, name), "file://" + os.path.abspath(folder) + "/"
    in_database = os.path.exists(os.path.join(folder, DATABASE))
    store = {"driver": "ocdbt", "base": root, "path": name + "/"} if in_database else root + name + "/"
    try:
        array = tensorstore.open({"driver": driver, "kvstore": store}, read=True, open=True).result()
    except Exception as error:  # noqa: BLE001 - TensorStore raises errors of several classes
        raise refuse(where, "an array", str(error)[:200], "the checkpoint is damaged or not complete: download or save it again", Code.IO)
    if array.dtype.name not in TYPES or math.prod(array.shape) > MAX_ELEMENTS:
        raise refuse(where, "floats, at most {}".format(MAX_ELEMENTS), "{} of {}".format(array.shape, array.dtype.name))

    def read(part: object = slice(None)) -> np.ndarray:
        try:
            return np.asarray(array[part].read().result()).astype(np.float32)
        except Exception as error:  # noqa: BLE001
            raise refuse(where, "numbers", str(error)[:200], "the checkpoint is damaged: download or save it again", Code.IO)

    return Stored(tuple(array.shape), TYPES[array.dtype.name], read)

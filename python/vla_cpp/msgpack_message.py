# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""msgpack messages with NumPy arrays, as in openpi's protocol. Needs the extra `openpi`.

A peer's message is only data: nothing is executed, and limits are checked before memory or time is spent.
"""

from __future__ import annotations

import math
import re
from typing import Any, Dict

import numpy as np

from .errors import Incompatible
from .installed import extra_hint
from .printable import printable

try:
    import msgpack
except ImportError as error:
    raise ImportError(f"{error}; {extra_hint('openpi')}") from error

MAX_VALUES, MAX_DEPTH = 4096, 8  # limits of a message, the same as in `vla serve`
_DTYPE = re.compile(r"[<>|=]?(\?|[A-Za-z]{1,7}[0-9]{0,4})")


def pack(value: Any) -> bytes:
    """Packs a value that may contain NumPy arrays."""
    return msgpack.packb(value, default=_packed)


def unpack(data: bytes, address: str, is_answer: bool = False) -> Any:
    """Unpacks a message. Arrays may have the layout of `pack` or of the package msgpack-numpy.

    address    the sender, for errors
    is_answer  the texts are only displayed: control characters in them are replaced by escapes

    Errors: Incompatible.
    """
    try:
        return _Reader(data, is_answer).message()
    except (ValueError, TypeError, KeyError, OverflowError, msgpack.UnpackException) as problem:
        found = printable(f"other bytes ({problem})")
        raise Incompatible(address, "msgpack with NumPy arrays", found) from None


class _Reader:
    """Reads maps and lists itself, so that it can count values as it reads; msgpack reads the other values."""

    def __init__(self, data: bytes, is_answer: bool) -> None:
        self._data, self._is_answer = memoryview(data), is_answer
        self._unpacker = msgpack.Unpacker(max_buffer_size=max(len(data), 1), ext_hook=_no_extension)
        self._unpacker.feed(data)
        self._left = MAX_VALUES

    def message(self) -> Any:
        value = self._value(MAX_DEPTH)
        if self._unpacker.tell() != len(self._data):
            raise ValueError("more after its end")
        return value

    def _value(self, depth: int) -> Any:
        self._left -= 1
        if self._left < 0:
            raise ValueError(f"more than {MAX_VALUES} values")
        at = self._unpacker.tell()
        first = self._data[at] if at < len(self._data) else 0xC1
        is_map, is_list = first >> 4 == 8 or first in (0xDE, 0xDF), first >> 4 == 9 or first in (0xDC, 0xDD)
        if (is_map or is_list) and not depth:
            raise ValueError(f"more than {MAX_DEPTH} levels")
        if is_map:
            return self._map(self._unpacker.read_map_header(), depth - 1)
        if is_list:
            return [self._value(depth - 1) for _ in range(self._unpacker.read_array_header())]
        value = self._unpacker.unpack()
        if isinstance(value, msgpack.Timestamp):
            raise ValueError("a time")
        return printable(value) if self._is_answer and isinstance(value, str) else value

    def _map(self, n: int, depth: int) -> Any:
        members: Dict[Any, Any] = {}
        for _ in range(n):
            key = self._value(depth)
            if key in members:
                raise ValueError("a key twice")
            members[key] = self._value(depth)
        return _array(members)


def _no_extension(code: int, data: bytes) -> Any:
    raise ValueError(f"an extension of type {code}")


def _packed(value: Any) -> Any:
    """An array in the layout of openpi's own client."""
    return {b"__ndarray__": True, b"data": value.tobytes(), b"dtype": value.dtype.str, b"shape": value.shape}


def _array(value: Dict[Any, Any]) -> Any:
    """The array that a map represents in the layout of openpi or of msgpack-numpy, with keys as bytes or text; else the map itself."""
    fields = {key.decode("utf-8", "replace") if isinstance(key, bytes) else key: item for key, item in value.items()}
    if not {"__ndarray__", "__npgeneric__", "nd"} & set(fields):
        return value
    data, dtype, shape = fields["data"], _dtype(fields.get("dtype", fields.get("type"))), fields.get("shape", ())
    if "__npgeneric__" in fields:
        if not isinstance(data, (bool, int, float, str)):
            raise ValueError("a scalar that is none")
        return data
    if not isinstance(shape, (list, tuple)) or not all(isinstance(n, int) and n >= 0 for n in shape):
        raise ValueError("an array without a shape")
    if not isinstance(data, bytes) or math.prod(shape) * dtype.itemsize != len(data):
        raise ValueError(f"an array of {dtype} {tuple(shape)} with other bytes")
    array = np.ndarray(shape, dtype, data)
    return array if shape else array[()]


def _dtype(name: Any) -> np.dtype:
    """The dtype of that name. Errors: ValueError for other types than numbers of up to eight bytes and texts."""
    dtype = np.dtype(name) if isinstance(name, str) and _DTYPE.fullmatch(name) else None
    if dtype is None or dtype.kind not in "biufU" or (dtype.kind != "U" and dtype.itemsize > 8):
        raise ValueError(f"an array of {str(name)[:80]}")
    return dtype

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""A bounded reader of files of torch.save: ZIP archives with a pickle and one uncompressed entry per storage.

The pickle is read as data (pickle_values.py): tensors become positions in the file, every other object becomes an inert record, and
nothing is imported or executed. Numbers are read in chunks, as from a safetensors file.
"""

from __future__ import annotations

import os
import struct
import zipfile
from typing import Dict, NamedTuple, Tuple

from .dtypes import SIZES
from .errors import Code, refuse
from .files import open_file
from .pickle_values import MAX_BYTES, Global, describe, ordered_dict, read_pickle
from .safetensors_file import Entry, check_count

STORAGES = {
    "BoolStorage": "BOOL",
    "ByteStorage": "U8",
    "CharStorage": "I8",
    "ShortStorage": "I16",
    "HalfStorage": "F16",
    "BFloat16Storage": "BF16",
    "IntStorage": "I32",
    "FloatStorage": "F32",
    "LongStorage": "I64",
    "DoubleStorage": "F64",
}
DAMAGED = "the file is truncated or damaged: download or save it again"
LOCAL_HEADER, LOCAL_MAGIC = 30, b"PK\3\4"


class Stored(NamedTuple):
    """The position of a ZIP entry's bytes in the file."""

    offset: int
    n_bytes: int


class Storage(NamedTuple):
    """The storage that a persistent id names: elements of one type, in one entry of the archive."""

    key: str
    dtype: str
    n_element: int


class Tensor(NamedTuple):
    storage: Storage
    first: int  # index of the tensor's first element in the storage
    shape: Tuple[int, ...]
    stride: Tuple[int, ...]


def _counts(value) -> bool:
    return isinstance(value, tuple) and len(value) <= 8 and all(_is_count(item) for item in value)


def _is_count(value) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 1 << 48


def _storage(name) -> object:
    """The storage of a persistent id ("storage", type, key, device, number of elements); None for another kind of id."""
    if not isinstance(name, tuple) or len(name) != 5 or name[0] != "storage" or not isinstance(name[1], Global):
        return None
    _, kind, key, _, n_element = name
    if not isinstance(key, str) or not _is_count(n_element):
        raise ValueError("a storage without key and size")
    return Storage(key, STORAGES.get(kind.name.partition(" ")[2], describe(kind)), n_element)


def _tensor(arguments: tuple) -> Tensor:
    """The value of a call torch._utils._rebuild_tensor_v2(storage, offset, size, stride, ...)."""
    if len(arguments) < 4 or not _is_count(arguments[1]) or not _counts(arguments[2]) or not _counts(arguments[3]):
        raise ValueError("a tensor without storage, offset, size and stride")
    if not isinstance(arguments[0], Storage) or len(arguments[2]) != len(arguments[3]):
        raise ValueError("a tensor without a storage, or with a stride of another rank")
    return Tensor(*arguments[:4])


def _parameter(arguments: tuple):
    if not arguments:
        raise ValueError("a parameter without data")
    return arguments[0]


CALLS = {"torch._utils _rebuild_tensor_v2": _tensor, "torch._utils _rebuild_parameter": _parameter, "collections OrderedDict": ordered_dict}


def _entries(path: str) -> Dict[str, Stored]:
    """Every entry of the archive by name. Checks the archive's directory against the file."""
    with open_file(path) as file:
        size = os.fstat(file.fileno()).st_size
        try:
            with zipfile.ZipFile(file) as archive:
                infos = archive.infolist()
            result: Dict[str, Stored] = {}
            for info in infos:
                where = "{}: entry {}".format(path, info.filename[:100])
                if info.compress_type != zipfile.ZIP_STORED or info.flag_bits & 1 or info.file_size != info.compress_size:
                    raise refuse(where, "an entry that is stored as it is", "a compressed or encrypted one")
                if info.filename in result:
                    raise refuse(where, "one entry of this name", "two")
                result[info.filename] = _place(file, info, size, where)
        except OSError as error:
            raise refuse(path, "a readable file", error.strerror or str(error), code=Code.IO)
        except (zipfile.BadZipFile, ValueError, struct.error, RuntimeError, OverflowError, EOFError) as error:
            hint = "{}; files of torch before 1.6 are no archives: save them again with a later one".format(DAMAGED)
            raise refuse(path, "an archive of torch.save", str(error)[:200], hint)
    _check_apart(path, result)
    return result


def _place(file, info: zipfile.ZipInfo, size: int, where: str) -> Stored:
    """The position of an entry's bytes: after its local header, whose name and extra field may be longer than those in the directory."""
    file.seek(info.header_offset)
    header = file.read(LOCAL_HEADER)
    if len(header) < LOCAL_HEADER or header[:4] != LOCAL_MAGIC:
        raise refuse(where, "a header at byte {}".format(info.header_offset), "none", DAMAGED)
    offset = info.header_offset + LOCAL_HEADER + sum(struct.unpack("<HH", header[26:30]))
    if offset + info.file_size > size:
        raise refuse(where, "data up to byte {}".format(offset + info.file_size), "a file of {} bytes".format(size), DAMAGED)
    return Stored(offset, info.file_size)


def _check_apart(path: str, entries: Dict[str, Stored]) -> None:
    end = 0
    for name, entry in sorted(entries.items(), key=lambda item: item[1]):
        if entry.offset < end:
            raise refuse("{}: entry {}".format(path, name[:100]), "bytes of its own", "those of another entry", DAMAGED)
        end = entry.offset + entry.n_bytes


def _read(path: str, entry: Stored, where: str) -> bytes:
    if entry.n_bytes > MAX_BYTES:
        raise refuse(where, "at most {} bytes".format(MAX_BYTES), "{} bytes".format(entry.n_bytes))
    with open_file(path) as file:
        file.seek(entry.offset)
        return file.read(entry.n_bytes)


def _position(path: str, name: str, value, entries: Dict[str, Stored], root: str) -> Entry:
    """The position of a tensor of the state dictionary in the file. Errors for any other value."""
    where = "{}: tensor {}".format(path, name)
    if not isinstance(value, Tensor):
        raise refuse(where, "a tensor", describe(value), "only the torch functions that rebuild tensors are understood")
    storage = value.storage
    if storage.dtype not in SIZES:
        raise refuse(where, "a storage of " + ", ".join(sorted(STORAGES)), storage.dtype)
    stored, item = entries.get("{}data/{}".format(root, storage.key)), SIZES[storage.dtype]
    if stored is None or stored.n_bytes != storage.n_element * item:
        found = "no such entry" if stored is None else "{} bytes".format(stored.n_bytes)
        raise refuse(where, "{} bytes in data/{}".format(storage.n_element * item, storage.key[:100]), found, DAMAGED)
    n_element = 1
    for size, stride in zip(value.shape[::-1], value.stride[::-1]):
        if size > 1 and stride != n_element:
            raise refuse(where, "rows one after another", "strides {} for {}".format(value.stride, value.shape), "save contiguous tensors")
        n_element *= size
    if value.first + n_element > storage.n_element:
        raise refuse(where, "at most {} elements".format(storage.n_element), "{} from {} on".format(n_element, value.first), DAMAGED)
    return Entry(name, storage.dtype, value.shape, path, stored.offset + value.first * item, n_element * item)


def _content(path: str) -> Tuple[object, Dict[str, Stored], str]:
    """The saved value, the entries of the archive, and the entries' common folder."""
    entries = _entries(path)
    roots = [name[: -len("data.pkl")] for name in entries if name.endswith("data.pkl") and name.count("/") == 1]
    if len(roots) != 1:
        raise refuse(path, "an archive of torch.save, with data.pkl in one folder", "{} of them".format(len(roots)), DAMAGED)
    root = roots[0]
    if root + "byteorder" in entries and _read(path, entries[root + "byteorder"], path) != b"little":
        raise refuse(path + ": byteorder", "little", "another", "save the file on a little-endian machine")
    where = path + ": data.pkl"
    return read_pickle(_read(path, entries[root + "data.pkl"], where), where, CALLS, _storage), entries, root


def read_torch_value(path: str, member: str) -> object:
    """The value of `member` in the saved dictionary, e.g. a config; None if there is none."""
    content, _, _ = _content(path)
    return content.get(member) if isinstance(content, dict) else None


def read_torch(path: str, member: str) -> Dict[str, Entry]:
    """The tensors of a state dictionary, without their data. `member`: the key of the state dictionary in the saved dictionary; empty if the
    saved value is the state dictionary itself."""
    (content, entries, root), where = _content(path), path + ": data.pkl"
    state = content.get(member) if isinstance(content, dict) and member else content
    if not isinstance(state, dict) or not state:
        expected = "a dictionary with the tensors" + (" under " + member if member else "")
        raise refuse(where, expected, describe(content if state is None else state))
    check_count(where, len(state))
    names = [name for name in state if not isinstance(name, str)]
    if names:
        raise refuse(where + ": " + member, "names of tensors", type(names[0]).__name__)
    return {name: _position(path, name, value, entries, root) for name, value in state.items()}

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Reads files of a checkpoint; errors name the file."""

from __future__ import annotations

import json
import os
import stat
from typing import BinaryIO

from ..installed import extra_hint
from ..strict_json import no_constant
from .errors import Code, ConvertError, refuse

MAX_JSON = 256 << 20  # bytes; the largest tokenizers have about 20 MB


def open_file(path: str) -> BinaryIO:
    """Opens a regular file for reading. Refuses a pipe, which would block, and a device, which may have no end. Errors: io."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)  # O_NONBLOCK: opening a pipe does not wait for its writer
    except OSError as error:
        raise refuse(path, "a readable file", error.strerror or str(error), code=Code.IO)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise refuse(path, "a file", "something that is not a regular file", code=Code.IO)
    return os.fdopen(descriptor, "rb")


def read_file(path: str, max_bytes: int = MAX_JSON) -> bytes:
    """All bytes of a file. Errors: io when it cannot be read, bad_bundle when it is larger than `max_bytes`."""
    with open_file(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > max_bytes:
            raise refuse(path, "at most {} bytes".format(max_bytes), "{} bytes".format(size))
        try:
            return file.read(max_bytes)
        except OSError as error:
            raise refuse(path, "a readable file", error.strerror or str(error), code=Code.IO)


def read_text(path: str) -> str:
    """The text of a UTF-8 file. Errors: io, bad_bundle."""
    try:
        return read_file(path).decode("utf-8")
    except UnicodeDecodeError as error:
        raise refuse(path, "UTF-8 text", str(error))


def read_json(path: str) -> dict:
    """The JSON object in a file. Errors: io when the file cannot be read, bad_bundle when it holds anything else."""
    data = read_file(path)
    try:
        value = json.loads(data.decode("utf-8"), parse_constant=no_constant)
    except (ValueError, RecursionError) as error:
        raise refuse(path, "JSON", str(error)[:200], "the file is damaged: download or save it again")
    if not isinstance(value, dict):
        raise refuse(path, "a JSON object", type(value).__name__)
    return value


KINDS = {dict: "a JSON object", list: "a list", str: "a string"}


def member(value: dict, key: str, kind: type, where: str):
    """A member of a JSON object, of type `kind` (dict, list or str); an absent member is an empty one. Errors: bad_bundle."""
    found = value.get(key)
    if found is None:
        return kind()
    if not isinstance(found, kind):
        raise refuse("{}: {}".format(where, key), KINDS[kind], repr(found)[:80])
    return found


def plain_name(name) -> bool:
    """Whether a file name that a checkpoint states stays inside the checkpoint's folder."""
    return isinstance(name, str) and bool(name) and name not in (".", "..") and not set(name) & set("/\\\0")


def missing_extra(package: str) -> ConvertError:
    return refuse("vla-convert", "the package " + package, "none", extra_hint("convert"), Code.USAGE)

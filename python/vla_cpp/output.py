# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Output files of the programs, written with the rules of the runtime's `write_file` (src/base/file.h)."""

from __future__ import annotations

import errno
import os
import re
import secrets
import shutil
import stat
import tempfile
from contextlib import contextmanager, suppress
from typing import BinaryIO, Iterator, Optional, Union

OPEN_FILES = {"/dev/stdout": 1, "/dev/stderr": 2}
Path = Union[str, "os.PathLike[str]"]


def open_file(path: Path) -> Optional[int]:
    """The file descriptor that a path such as /dev/stdout or /dev/fd/3 names; None for other paths."""
    found = re.fullmatch(r"/(?:dev|proc/self)/fd/(\d+)", os.fspath(path))
    return int(found[1]) if found else OPEN_FILES.get(os.fspath(path))


def is_special(path: Path) -> bool:
    """Whether `path` is written in place, without a temporary file: a pipe, a device or an open file."""
    return open_file(path) is not None or (os.path.exists(path) and not os.path.isfile(path) and not os.path.isdir(path))


def is_file(path: Path) -> bool:
    """Whether writing to `path` would replace a file."""
    return open_file(path) is None and os.path.isfile(path)


@contextmanager
def whole_file(path: Path) -> Iterator[BinaryIO]:
    """A temporary file, writable in any order, that becomes `path` when the block ends and is removed when the block raises.

    Its `name` is a path beside `path`, for a library that opens the file itself. It gets the mode of the file that it replaces. A link is
    followed and kept. A pipe, a device, and an open file such as /dev/stdout receive the bytes when the block ends; the temporary file is
    then in the system's folder for those. Errors: OSError.
    """
    path, in_place = os.fspath(path), is_special(path)
    target = os.path.realpath(path)
    mode = os.stat(target).st_mode if os.path.lexists(target) else None  # OSError for a link that leads to itself
    if not in_place and stat.S_ISDIR(mode or 0):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), path)
    part = "{}.{}.part".format(os.path.join(tempfile.gettempdir(), "vla") if in_place else target, secrets.token_hex(4))
    try:
        with open(part, "x+b") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        if in_place:
            with open(part, "rb") as made, os.fdopen(_opened(path), "wb") as out:
                shutil.copyfileobj(made, out, 1 << 20)
        else:
            if mode is not None:
                os.chmod(part, stat.S_IMODE(mode))
            os.replace(part, target)
    finally:
        with suppress(FileNotFoundError):
            os.remove(part)


def _opened(path: str) -> int:
    descriptor = open_file(path)
    return os.open(path, os.O_WRONLY | os.O_CLOEXEC) if descriptor is None else os.dup(descriptor)


def write_text(path: Path, text: str) -> None:
    with whole_file(path) as file:
        file.write(text.encode("utf-8"))

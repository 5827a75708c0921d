# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""How the programs write a file: as `write_file` of the runtime does (src/base/file.h)."""

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
    """The descriptor that a path such as /dev/stdout or /dev/fd/3 stands for, whatever it leads to; None for other paths."""
    found = re.fullmatch(r"/(?:dev|proc/self)/fd/(\d+)", os.fspath(path))
    return int(found[1]) if found else OPEN_FILES.get(os.fspath(path))


def is_special(path: Path) -> bool:
    """Whether `path` is written to as it is: a pipe, a device or an open file."""
    return open_file(path) is not None or (os.path.exists(path) and not os.path.isfile(path) and not os.path.isdir(path))


def is_file(path: Path) -> bool:
    """Whether there is a file that writing to `path` would replace."""
    return open_file(path) is None and os.path.isfile(path)


@contextmanager
def whole_file(path: Path) -> Iterator[BinaryIO]:
    """A file to write to in any order, which becomes `path` when the block ends and is gone when it raises.

    Its `name` is a path beside `path`, for a library that opens the file itself. It takes the mode of a file that it replaces. Links are
    followed, and stay. What is no regular file, such as a pipe or a device, and an open file such as /dev/stdout get the bytes when all of
    them are made. Errors: OSError.
    """
    path, in_place = os.fspath(path), is_special(path)
    target = os.path.realpath(path)
    mode = os.stat(target).st_mode if os.path.lexists(target) else None  # a link that leads to itself has none: OSError
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

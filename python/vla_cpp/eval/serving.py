# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Starts `vla serve` for a run and ends it."""

from __future__ import annotations

import ctypes
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import IO, List, Optional

from ..installed import source_tree

ADDRESS = re.compile(r"\b(?:tcp|ipc)://\S+")


def die_with_parent() -> None:
    """Called in a child: the system kills it when its parent ends, for whatever reason. Linux only; elsewhere nothing happens."""
    try:
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
    except (OSError, AttributeError):
        pass


class ServerFailed(Exception):
    """The server did not become ready, or went away. Says what it wrote last."""


def find_vla(named: str) -> str:
    """The program: what was named, or VLA_BINARY, or `vla` of the PATH. Errors: ServerFailed."""
    name = named or os.environ.get("VLA_BINARY", "vla")
    found = shutil.which(name)
    if found is None:
        how = "build it (make build) and name it with --vla build/cpu/bin/vla" if source_tree() else "name it with --vla FILE"
        raise ServerFailed(f"cannot find the program '{name}': {how}")
    return found


class Server:
    """A `vla serve` of our own, on a free port of this machine."""

    def __init__(self, vla: str, bundle: Path, threads: int, kernels: str = "") -> None:
        command: List[str] = [find_vla(vla), "serve", str(bundle), "--bind", "tcp://127.0.0.1:*", "--threads", str(threads)]
        command += ["--kernels", kernels] if kernels else []
        self._log: IO[bytes] = tempfile.TemporaryFile()
        self._process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=self._log, preexec_fn=die_with_parent
        )
        self.ready_line = self._process.stdout.readline().decode("utf-8", "replace").strip()  # type: ignore[union-attr]
        address = ADDRESS.search(self.ready_line)
        if address is None:
            self._process.wait()
            raise ServerFailed(f"vla serve did not start: {self.last_words() or self.ready_line or 'it said nothing'}")
        self.address = address.group().rstrip(",;")

    @property
    def pid(self) -> int:
        return self._process.pid

    def fault(self) -> Optional[str]:
        """Why the server ended, if it did."""
        code = self._process.poll()
        if code is None:
            return None
        how = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
        return f"the server ended with {how}. {self.last_words()}".strip()

    def last_words(self) -> str:
        self._log.seek(0)
        return self._log.read()[-2000:].decode("utf-8", "replace").strip()

    def __enter__(self) -> "Server":
        return self

    def __exit__(self, *_: object) -> None:
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGTERM)
            try:
                self._process.wait(20)
            except subprocess.TimeoutExpired:
                print("the server does not end; killing it", file=sys.stderr)
                self._process.kill()
                self._process.wait()
        self._process.stdout.close()  # type: ignore[union-attr]
        self._log.close()

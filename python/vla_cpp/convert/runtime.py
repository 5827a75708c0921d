# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What `vla` is asked for, where it is at hand: to open a bundle that was written, and to make codes of int8 or int4, so that one place decides
what a code is. Converting floats needs no `vla`."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path
from typing import List, Sequence

from ..program import candidates
from .errors import Code, refuse

NONE = "none"  # --vla: no program is asked
REFUSALS = (Code.BAD_BUNDLE, Code.UNSUPPORTED)  # what else keeps `vla` from opening a bundle is the machine's matter


def program(given: str, does: str = "makes codes") -> str:
    """The path of `vla`, as given or found. Raises ConvertError where there is none."""
    named = given or os.environ.get("VLA_BINARY")
    places = [Path(named)] if named else candidates()
    for path in places:
        if path.is_file():
            return str(path)
    hint = "build it (make build), or name it by VLA_BINARY"
    raise refuse("vla, which " + does, " or ".join(map(str, places)), "no such file", hint, Code.IO)


def find(given: str) -> str:
    """The path of `vla`: as given, beside this package, or on PATH; empty where there is none, or none is wanted."""
    if given == NONE:
        return ""
    if given or os.environ.get("VLA_BINARY"):
        return program(given, "opens the bundle")
    return next((str(path) for path in candidates() if path.is_file()), shutil.which("vla") or "")


def check(vla: str, bundle: str, name: str, robots: Sequence[str]) -> str:
    """Asks `vla` to open a bundle, for each of its robots if it has several. `name`: of the bundle in what it says. Returns why it could not
    say. Raises ConvertError with what it refuses."""
    for robot in robots or [""]:
        try:
            done = _run([vla, "inspect", bundle, *(["--embodiment", robot] if robot else [])])
        except OSError as error:
            return "{}: {}".format(vla, error.strerror or error)
        if done.returncode in REFUSALS:
            hint = "the converter and this vla disagree, or one of them is older; --vla names another, --vla none asks none"
            raise refuse(
                "{}, opened by {}".format(name, vla), "a bundle that it runs", _said(done, bundle, name), hint, Code(done.returncode)
            )
        if done.returncode:
            return "{}: {}".format(vla, _said(done, bundle, name))
    return ""


def quantize(vla: str, bundle: str, out: str, dtype: str, force: bool) -> None:
    """Writes `out`, of a bundle of floats. Raises ConvertError with what `vla quantize` says."""
    done = _run([vla, "quantize", bundle, "-o", out, "--dtype", dtype, "--quiet", *(["--force"] if force else [])])
    if done.returncode:
        code = Code(done.returncode) if done.returncode in list(map(int, Code)) else Code.INTERNAL
        raise refuse("vla quantize --dtype " + dtype, "a bundle of codes", _said(done, bundle, bundle), code=code)


def _run(command: List[str]) -> subprocess.CompletedProcess:
    return subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True)


def _said(done: subprocess.CompletedProcess, bundle: str, name: str) -> str:
    """In one line."""
    lines = [line.strip() for line in done.stderr.replace(bundle, name).splitlines() if line.strip()]
    return "; ".join(lines).partition("error: ")[2] or "; ".join(lines) or "exit code {}".format(done.returncode)

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Runs the program `vla`: to open a written bundle as a check, if the program is found, and to quantize to int8 or int4, so that only the
runtime defines the codes. Converting floats needs no `vla`."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path
from typing import List, Sequence

from ..program import candidates
from .errors import Code, refuse

NONE = "none"  # --vla: run no program
REFUSALS = (Code.BAD_BUNDLE, Code.UNSUPPORTED)  # exit codes that blame the bundle; others have causes in this machine


def program(given: str, does: str = "makes codes") -> str:
    """The path of `vla`: the given one, else that of VLA_BINARY, else the usual places. Raises ConvertError if there is none."""
    named = given or os.environ.get("VLA_BINARY")
    places = [Path(named)] if named else candidates()
    for path in places:
        if path.is_file():
            return str(path)
    hint = "build it (make build), or name it by VLA_BINARY"
    raise refuse("vla, which " + does, " or ".join(map(str, places)), "no such file", hint, Code.IO)


def find(given: str) -> str:
    """The path of `vla`: the given one, else that of VLA_BINARY, of this package, or on PATH; empty if there is none, or `given` is "none"."""
    if given == NONE:
        return ""
    if given or os.environ.get("VLA_BINARY"):
        return program(given, "opens the bundle")
    return next((str(path) for path in candidates() if path.is_file()), shutil.which("vla") or "")


def check(vla: str, bundle: str, name: str, robots: Sequence[str]) -> str:
    """Opens a bundle with `vla`, once per robot if there are several. `name`: the bundle's name in messages. Returns why `vla` could not run
    the check, or "". Raises ConvertError if `vla` refuses the bundle."""
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
    """Quantizes a bundle of floats into `out`. Raises ConvertError with the message of `vla quantize`."""
    done = _run([vla, "quantize", bundle, "-o", out, "--dtype", dtype, "--quiet", *(["--force"] if force else [])])
    if done.returncode:
        code = Code(done.returncode) if done.returncode in list(map(int, Code)) else Code.INTERNAL
        raise refuse("vla quantize --dtype " + dtype, "a bundle of codes", _said(done, bundle, bundle), code=code)


def _run(command: List[str]) -> subprocess.CompletedProcess:
    return subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True)


def _said(done: subprocess.CompletedProcess, bundle: str, name: str) -> str:
    """The program's error message in one line, with `name` instead of the path `bundle`."""
    lines = [line.strip() for line in done.stderr.replace(bundle, name).splitlines() if line.strip()]
    return "; ".join(lines).partition("error: ")[2] or "; ".join(lines) or "exit code {}".format(done.returncode)

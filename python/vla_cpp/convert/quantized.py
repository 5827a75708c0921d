# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Bundles of int8 or int4 codes. `vla quantize` makes them, so that one place decides what a code is."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

from ..program import candidates
from .errors import Code, refuse


def program() -> str:
    """The path of `vla`. Raises ConvertError where there is none."""
    named = os.environ.get("VLA_BINARY")
    places = [Path(named)] if named else candidates()
    for path in places:
        if path.is_file():
            return str(path)
    hint = "build it (make build), or name it by VLA_BINARY"
    raise refuse("vla, which makes codes", " or ".join(map(str, places)), "no such file", hint, Code.IO)


def quantize(vla: str, bundle: str, out: str, dtype: str, force: bool) -> None:
    """Writes `out`, of a bundle of floats. Raises ConvertError with what `vla quantize` says."""
    command = [vla, "quantize", bundle, "-o", out, "--dtype", dtype, "--quiet", *(["--force"] if force else [])]
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True)
    if done.returncode:
        said = done.stderr.strip() or "exit code {}".format(done.returncode)
        code = Code(done.returncode) if done.returncode in list(map(int, Code)) else Code.INTERNAL
        raise refuse("vla quantize --dtype " + dtype, "a bundle of codes", said, code=code)

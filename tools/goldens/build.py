# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Makes checkpoint and bundle of every golden case, once for all builds and test programs.

A case of build/goldens/ is a folder with checkpoint/, bundle.gguf and links to what tests/golden/ records of it.  The hashes that
tests/golden/hashes.json states must come out: those of a checkpoint because expected.gguf was recorded from exactly these weights, those
of a bundle because a change of the converter that moves a byte should be meant.
"""

import fcntl
import hashlib
import json
import os
import shutil
import sys

from . import all_cases
from .cases import RECORDED, ROOT, write_bundle, write_checkpoint

FOLDER = ROOT / "build/goldens"
HASHES = RECORDED / "hashes.json"


def digest(*paths):
    """Of names and contents of all files below the paths."""
    out = hashlib.sha256()
    for path in paths:
        for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
            if file.is_file() and "__pycache__" not in file.parts:
                out.update(f"{file.relative_to(path.parent)}\0{file.stat().st_size}\0".encode() + file.read_bytes())
    return out.hexdigest()


def state():
    """What the generated files follow from, and the names of what they link to."""
    names = sorted(str(file.relative_to(RECORDED)) for file in RECORDED.glob("*/*/*"))
    sources = digest(ROOT / "tools/goldens", ROOT / "python/vla_cpp/convert", RECORDED / "tokenizers", HASHES)
    return sources + hashlib.sha256("\n".join(names).encode()).hexdigest()


def make_case(name, case):
    """The case's folder.  Returns its hashes."""
    folder, recorded = FOLDER / name, RECORDED / name
    shutil.rmtree(folder, ignore_errors=True)
    write_checkpoint(case, folder)
    for file in recorded.glob("*"):
        (folder / file.name).symlink_to(os.path.relpath(file, folder))
    write_bundle(folder)
    return {"checkpoint": digest(folder / "checkpoint"), "bundle": digest(folder / "bundle.gguf")}


def make(accept=False):
    """Makes what is not there.  accept: states the hashes that come out instead of comparing them.  Returns the folder."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    with open(FOLDER / "lock", "w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            print(f"waiting for {lock.name}: another program makes the golden cases", file=sys.stderr)
            fcntl.flock(lock, fcntl.LOCK_EX)
        stamp = FOLDER / "stamp"
        if not accept and stamp.is_file() and stamp.read_text() == state():
            return FOLDER
        stamp.unlink(missing_ok=True)
        sys.path.insert(0, str(ROOT / "python"))
        found = {name: make_case(name, case) for name, case in all_cases().items()}
        stated = json.loads(HASHES.read_text())
        if accept:
            HASHES.write_text(json.dumps(dict(sorted(found.items())), indent=1) + "\n")
        elif found != stated:
            differ = [f"{name} ({what})" for name in found for what in found[name] if found[name][what] != stated.get(name, {}).get(what)]
            raise SystemExit(f"error: {HASHES}: other bytes came out for {', '.join(differ)}; where that is meant, run "
                             "`python tools/goldens make --accept`")
        stamp.write_text(state())
    return FOLDER

#!/usr/bin/env python3
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Damaged checkpoints through the converter: each is a refusal or a bundle, in bounded time and memory.

tests/fuzz/checkpoint_fuzz.py SECONDS [SEED]     exit code 1 and the damaged folder's name for the first that is neither
"""

import contextlib
import os
import random
import resource
import shutil
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "python"), str(ROOT / "tests" / "cli")]

from golden_cases import NAMES, Golden  # noqa: E402
from vla_cpp.convert.cli import main as convert  # noqa: E402

MOST_SECONDS, MOST_BYTES = 20, 4 << 30
REFUSALS = (2, 3, 6, 9)  # usage, as an option may name what the damage hit; bad_bundle, unsupported, io
ODD = [b"\0", b"\1", b"\x7f", b"\x80", b"\xff", b'"', b"{", b"-1", b"1e400", b"999999999999", b"null", b"[]"]


def damaged(data, rng):
    """A few bytes flipped, replaced, cut out or repeated. Headers are hit as often as all the numbers behind them."""
    data = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(max(1, min(len(data), rng.choice([64, 2000, len(data)]))))
        kind = rng.randrange(5)
        if kind == 0 and data:
            data[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            odd = rng.choice(ODD)
            data[at : at + len(odd)] = odd
        elif kind == 2:
            del data[at : at + rng.randint(1, 16)]
        elif kind == 3:
            data[at:at] = data[at : at + rng.randint(1, 64)]
        else:
            del data[at:]
    return bytes(data)


def attempt(name, rng, folder):
    """Converts the checkpoint of a golden case with one file of it damaged. Returns the exit code, and what is wrong with
    that, if anything."""
    case = Golden(name)
    checkpoint = folder / "checkpoint"
    shutil.copytree(case.folder / "checkpoint", checkpoint)
    file = rng.choice(sorted(path for path in checkpoint.rglob("*") if path.is_file()))
    file.write_bytes(damaged(file.read_bytes(), rng))
    backbone = next((path for path in (checkpoint / "vlm", checkpoint / "tokenizer") if path.is_dir()), None)
    arguments = [str(checkpoint), "-o", str(folder / "out.gguf"), "--quiet", *case.conversion()]
    start = time.process_time()
    try:
        code = convert(arguments + (["--backbone", str(backbone)] if backbone else []))
    except Exception as error:
        return None, f"{folder}: {file.relative_to(checkpoint)}: {error!r}"
    took = time.process_time() - start
    is_sound = code in REFUSALS or code == 0
    if is_sound and took <= MOST_SECONDS and (code == 0) == (folder / "out.gguf").exists():
        return code, None
    return code, f"{folder}: {file.relative_to(checkpoint)}: exit code {code} after {took:.1f} s"


def main():
    seconds, seed = float(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 1
    resource.setrlimit(resource.RLIMIT_AS, (MOST_BYTES, MOST_BYTES))
    rng, end, codes = random.Random(seed), time.monotonic() + seconds, {}
    while time.monotonic() < end:
        folder = Path(tempfile.mkdtemp(prefix="vla-checkpoint-fuzz-"))
        with open(os.devnull, "w") as nowhere, contextlib.redirect_stderr(nowhere):  # a thousand refusals
            code, wrong = attempt(rng.choice(NAMES), rng, folder)
        if wrong:
            print("FOUND", wrong)
            return 1
        codes[code] = codes.get(code, 0) + 1
        shutil.rmtree(folder)
    print("checkpoints by exit code:", dict(sorted(codes.items())))
    return 0


if __name__ == "__main__":
    sys.exit(main())

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The inner loops of the kernels for 64-bit ARM neither spill registers nor move vectors, as the compiler makes them.

Needs that compiler alone (Debian's g++-aarch64-linux-gnu); `make test` does not install it, `make test-arm64` does.
"""

import re
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
COMPILER = "aarch64-linux-gnu-g++"
sys.path.insert(0, str(ROOT / "scripts"))

import arm64_cycles  # noqa: E402

pytestmark = pytest.mark.skipif(shutil.which(COMPILER) is None, reason=f"{COMPILER} is not installed")


def compiled(folder, source):
    """As the build compiles it (src/CMakeLists.txt says for which instructions)."""
    instructions = dict(re.findall(r"set\((\w+) (-march=\S+)\)", (ROOT / "src/CMakeLists.txt").read_text()))
    march = [flag for name, flag in instructions.items() if source.endswith(f"_{name}")]
    path = ROOT / f"src/kernels/arm/{source}.cpp"
    command = [COMPILER, "-std=c++20", "-O3", "-DNDEBUG", "-fPIC", "-ffp-contract=off", *march, f"-I{ROOT / 'src'}"]
    subprocess.run([*command, "-c", path, "-o", folder / f"{source}.cpp.o"], check=True)


def table(folder):
    script = [sys.executable, ROOT / "scripts/arm64_cycles.py", "--objects", folder, "--mca", ""]
    return subprocess.run(script, capture_output=True, text=True)


def test_no_inner_loop_spills_registers_or_moves_vectors(tmp_path):
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(lambda source: compiled(tmp_path, source), {loop[0] for loop in arm64_cycles.LOOPS}))
    found = table(tmp_path)
    assert found.returncode == 0, found.stdout + found.stderr
    assert found.stdout.count("\n") == len(arm64_cycles.LOOPS) + 2


def test_spills_moves_and_a_missing_loop_are_found():
    good = ["ldr q0, [x1]", "fmla v8.4s, v0.4s, v1.s[0]", "b.gt 0 <loop>"]
    assert arm64_cycles.wasted(good) == (0, 0)
    assert arm64_cycles.wasted([*good, "ldr q2, [sp, #16]", "mov v3.16b, v4.16b"]) == (1, 1)
    lines = list(enumerate(good))
    lines[2] = (2, "b.gt 0 <loop>")
    assert arm64_cycles.smallest_loop([lines], "fmla", 1) == good
    assert arm64_cycles.smallest_loop([lines], "fmla", 2) is None

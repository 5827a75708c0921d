# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""No code runs on a processor that lacks its instructions: what the compiler made is read back from the build.

A file's name says what it is compiled for (src/CMakeLists.txt). The rest of the program runs on any processor that ggml
is built for, and the kernels of better machines run on the pretended ones with their instructions in plain C++.
"""

import os
import platform
import re
import subprocess
from pathlib import Path

import pytest

BUILD = Path(os.environ["VLA_BINARY"]).parents[1] if "VLA_BINARY" in os.environ else Path("build/cpu")
INSTRUCTIONS = re.compile(r"_(avx2|avx512|avx512_bf16|amx)\.cpp\.o$")
# Registers of AVX-512 and AMX, and vectors of AVX and AVX2 with more than 16 bytes.
BETTER = re.compile(r"%(zmm|tmm|k[1-7]\b|[xy]mm(1[6-9]|2\d|3[01])\b)")
WIDE = re.compile(r"%ymm")
# Look at the processor themselves, at run time, before they call a function that is compiled so.
ASKS = {"letterbox.cpp.o", "resample_torch.cpp.o", "peak_probes.cpp.o"}
# All assembler: the pretended machine is of no maker for which it is chosen (tests/support/amx_processor.cpp).
NOT_EMULATED = {"int8_lookup_avx512"}

pytestmark = pytest.mark.skipif(
    platform.machine() not in ("x86_64", "AMD64"), reason="instruction sets of x86-64 on another processor"
)


def run(*command):
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def objects(folder="src"):
    found = sorted((BUILD / folder).rglob("*.cpp.o"))
    assert found, f"{BUILD / folder}: expected objects of a build, found none"
    return found


def weak_symbols(path):
    """Functions of which the linker keeps one, whoever compiled it: inline functions and instances of templates."""
    lines = (line.split() for line in run("nm", "--defined-only", path).splitlines())
    return {name for *_, kind, name in lines if kind == "W"}


def test_only_files_named_after_instructions_hold_them():
    wrong = []
    for path in objects():
        if INSTRUCTIONS.search(path.name) or path.name in ASKS:
            continue
        text = run("objdump", "-d", "--no-show-raw-insn", path)
        wrong += [f"{path.name}: {pattern.pattern}" for pattern in (BETTER, WIDE) if pattern.search(text)]
    assert wrong == []


def test_the_linker_cannot_choose_code_of_a_better_machine_for_all():
    by_set = {}
    for path in objects():
        named = INSTRUCTIONS.search(path.name)
        for name in weak_symbols(path):
            by_set.setdefault(name, {}).setdefault(named[1] if named else "any", []).append(path.name)
    shared = {name: places for name, places in by_set.items() if len(places) > 1}
    assert shared == {}, "inline functions compiled for several instruction sets: mark them VLA_INLINE or static"


def test_every_kernel_that_the_pretended_machine_can_choose_is_emulated():
    better = {path.name for path in objects("src/CMakeFiles/vla_kernels.dir/kernels/x86")}
    better = {name[: -len(".cpp.o")] for name in better if re.search(r"_(avx512|avx512_bf16|amx)\.cpp\.o$", name)}
    emulated = {path.name[: -len(".cpp.o")] for path in objects("tests/CMakeFiles/vla_emulated.dir")}
    assert better - emulated == NOT_EMULATED
    for path in objects("tests/CMakeFiles/vla_emulated.dir"):
        assert not BETTER.search(run("objdump", "-d", "--no-show-raw-insn", path)), path.name

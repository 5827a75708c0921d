# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Mistakes made in kernels, one at a time: the tests must see each. A kernel is compiled with the mistake to PTX, which
also shows those in assembly, and runs in the place of the right one."""

import os
import re
import shutil
from concurrent.futures import ThreadPoolExecutor

import cuda_kernels
from conftest import run_tests
from mistakes import MISTAKES, TESTS

# Of Hopper's many tiles a mistake is made in these alone, since all of them take nvcc half a minute.
TILES = {"64, 64", "64, 128", "128, 48", "128, 64", "128, 96", "192, 112"}


def with_few_tiles(header):
    """The text of a header whose lists of tiles name TILES alone."""
    return re.sub(r"each\((\d+, \d+)\)", lambda tile: tile[0] if tile[1] in TILES else "", header)


def outcome(name, ptx, folder):
    """What the tests say of a mistake: nothing where they do not see it."""
    file, kernel, old, new = MISTAKES[name]
    sources = folder / "src"
    shutil.copytree(cuda_kernels.SOURCES / "cuda/kernels", sources / "cuda/kernels")
    shutil.copytree(cuda_kernels.SOURCES / "base", sources / "base")
    place = sources / "cuda/kernels" / file
    text = place.read_text()
    assert text.count(old) >= 1, f"{name}: {file} has no {old!r}"
    place.write_text(text.replace(old, new))
    for header in (sources / "cuda/kernels").glob("linear_*.h"):
        header.write_text(with_few_tiles(header.read_text()))
    source = sources / f"cuda/kernels/{kernel}.cu"
    module = cuda_kernels.compile_ptx(source, folder, cuda_kernels.targets(source)[-1], sources, warnings=())
    code, output = run_tests([module, *ptx], f"--source-file={TESTS[kernel]}", "--abort-after=1")
    shutil.rmtree(folder)
    return output if code else ""


def test_every_mistake_in_a_kernel_is_seen(ptx, tmp_path):
    names = list(MISTAKES)[:: 1 if os.environ.get("VLA_ALL_MISTAKES") else 41]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        seen = dict(zip(names, pool.map(lambda name: outcome(name, ptx, tmp_path / str(names.index(name))), names)))
    for name, output in seen.items():
        said = [line for line in output.splitlines() if "ERROR" in line or "FATAL" in line]
        print(f"{name}: {said[0][:200] if said else output[-200:] if output else 'NOT SEEN'}")
    assert [name for name, output in seen.items() if not output] == []

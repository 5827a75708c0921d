# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Mistakes made in kernels, one at a time: the tests must see each. A kernel is compiled with the mistake to PTX, which
also shows those in assembly, and runs in the place of the right one."""

import os
import shutil
from concurrent.futures import ThreadPoolExecutor

import cuda_kernels
from conftest import run_tests
from mistakes import MISTAKES, TESTS


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
    source = sources / f"cuda/kernels/{kernel}.cu"
    module = cuda_kernels.compile_ptx(source, folder, cuda_kernels.targets(source)[-1], sources, warnings=())
    others = [one for one in ptx if one.name != module.name]
    code, output = run_tests([module, *others], f"--source-file={TESTS[kernel]}", "--abort-after=1")
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

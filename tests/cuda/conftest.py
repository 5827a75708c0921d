# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Kernels as nvcc makes them, run by the emulated machine of test_cuda. Where there is no nvcc, all of it skips."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "scripts"))

import cuda_kernels  # noqa: E402

# The driver of tests is a Hopper. Another architecture takes ptxas and nvdisasm half a minute; those before it have PTX of their own.
ARCHITECTURES = cuda_kernels.ARCHITECTURES if os.environ.get("VLA_ALL_ARCHITECTURES") else (90,)


def run_tests(modules, *options, program="VLA_TEST_CUDA"):
    """(exit code, output) of a program of tests with these files of PTX in the place of the host compiler's kernels."""
    chosen = [str(module) for module in modules if cuda_kernels.fits(module, 90)]  # what the driver of tests is
    environment = {**os.environ, "VLA_CUDA_PTX": ":".join(chosen)}
    process = subprocess.run(
        [os.environ[program], *options], env=environment, capture_output=True, text=True, timeout=1500
    )
    return process.returncode, process.stdout + process.stderr


@pytest.fixture(scope="session")
def ptx(tmp_path_factory):
    """Every kernel as PTX of every target that ARCHITECTURES run."""
    if not cuda_kernels.tool("nvcc"):
        pytest.skip("no nvcc: `make test` downloads it")
    return cuda_kernels.compile_all(tmp_path_factory.mktemp("ptx"), architectures=ARCHITECTURES)

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""One suite for every kind of device: VLA_TEST_DEVICE names it, vulkan or cuda.

Vulkan without a GPU: Mesa's lavapipe computes on the CPU. VK_DRIVER_FILES names another driver. CUDA without a GPU: VLA_FAKE_CUDA is
a folder with libcuda.so.1 and libvla-cuda.so of tests/cuda/library; with VLA_CUDA_LIBRARY that one takes the place of the second, and
its PTX is run.
"""

import os
import shutil
import sys
import tempfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "tests/cli"), str(ROOT / "tests/gpu"), str(ROOT / "python")]

from golden_cases import Golden  # noqa: E402
from program import Program  # noqa: E402

BINARY = Path(os.environ.get("VLA_BINARY", ROOT / "build/cpu/bin/vla"))
LAVAPIPE = sorted(Path("/usr/share/vulkan/icd.d").glob("lvp_icd.*json"))
if LAVAPIPE and "VK_DRIVER_FILES" not in os.environ:
    os.environ["VK_DRIVER_FILES"] = str(LAVAPIPE[0])
    os.environ["GGML_VK_VISIBLE_DEVICES"] = "0"  # ggml passes over a device that is a CPU unless it is named
# Compiling a shader takes lavapipe up to seconds; kept ones make the next run short.
os.environ.setdefault("MESA_SHADER_CACHE_DIR", str(ROOT / "build/shaders"))


KIND = os.environ.get("VLA_TEST_DEVICE", "vulkan")
FAKE = KIND == "cuda" and os.environ.get("VLA_FAKE_CUDA")
if FAKE:  # a folder of its own for the program, beside which libraries of devices are looked for
    folder = Path(tempfile.mkdtemp(prefix="vla-fake-cuda-"))
    library = os.environ.get("VLA_CUDA_LIBRARY") or Path(FAKE) / "libvla-cuda.so"
    for file, name in ((BINARY, "vla"), (os.environ["VLA_LIBRARY"], "libvla.so.1"), (library, "libvla-cuda.so")):
        shutil.copy(file, folder / name)
    BINARY = folder / "vla"
    os.environ["VLA_LIBRARY"], os.environ["LD_LIBRARY_PATH"] = str(folder / "libvla.so.1"), FAKE


def pytest_unconfigure():
    if FAKE:
        shutil.rmtree(BINARY.parent)


@pytest.fixture(scope="session")
def listed():
    """What `vla inspect --devices` tells about this kind."""
    lines = Program(BINARY)("inspect", "--devices").out.splitlines()
    return next(line for line in lines if line.startswith((f"{KIND}:0 ", f"no {KIND}: ")))


@pytest.fixture(scope="session")
def with_library(listed):
    if f": no libvla-{KIND}.so in " in listed:
        pytest.skip("no library: " + listed)
    return Program(BINARY)


@pytest.fixture(scope="session")
def vla(listed, with_library):
    if listed.startswith("no "):
        pytest.skip("no device: " + listed)
    return with_library


@pytest.fixture
def golden():
    return Golden("two_views")

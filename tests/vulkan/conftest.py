# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Vulkan without a GPU: Mesa's lavapipe computes on the CPU. VK_DRIVER_FILES names another driver."""

import os
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "tests/cli"), str(ROOT / "tests/vulkan"), str(ROOT / "python")]

from golden_cases import Golden  # noqa: E402
from program import Program  # noqa: E402

BINARY = Path(os.environ.get("VLA_BINARY", ROOT / "build/cpu/bin/vla"))
LAVAPIPE = sorted(Path("/usr/share/vulkan/icd.d").glob("lvp_icd.*json"))
if LAVAPIPE and "VK_DRIVER_FILES" not in os.environ:
    os.environ["VK_DRIVER_FILES"] = str(LAVAPIPE[0])
    os.environ["GGML_VK_VISIBLE_DEVICES"] = "0"  # ggml passes over a device that is a CPU unless it is named
# Compiling a shader takes lavapipe up to seconds; kept ones make the next run short.
os.environ.setdefault("MESA_SHADER_CACHE_DIR", str(ROOT / "build/shaders"))


@pytest.fixture(scope="session")
def vla():
    program = Program(BINARY)
    listed = program("inspect", "--devices").out
    if "vulkan:0" not in listed:
        pytest.skip("no device: " + next(line for line in listed.splitlines() if line.startswith("no vulkan")))
    return program


@pytest.fixture
def golden():
    return Golden("two_views")

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What `make gpu-kit` packs runs without the shell's environment, on a driver of tests, from a folder of its own, and says what it found."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import BINARY, FAKE
from golden_cases import ROOT

sys.path[:0] = [str(ROOT / "scripts"), str(ROOT / "scripts/gpu_kit")]
import gpu_table  # noqa: E402
import pack  # noqa: E402

pytestmark = pytest.mark.skipif(not FAKE, reason="no driver of tests: VLA_FAKE_CUDA")
PROGRAMS = Path(os.environ.get("VLA_BINARY", "")).parent


@pytest.fixture(scope="module")
def kit(tmp_path_factory):
    """The kit with programs that have the kernels of tests in the place of PTX."""
    kit = tmp_path_factory.mktemp("kit") / pack.NAME
    for folder in ("bin/ptx", "lib"):
        (kit / folder).mkdir(parents=True)
    for file in (BINARY, BINARY.parent / "libvla.so.1", BINARY.parent / "libvla-cuda.so", PROGRAMS / "bench_products", PROGRAMS / "bench_attention_gpu", PROGRAMS / "test_kernels_gpu"):
        shutil.copy(file, kit / "bin")
    pack.copy_tiny(kit / "bin/vla", kit)
    pack.copy_cases(kit, ["act/environment"])
    pack.copy_scripts(kit)
    return kit


def try_gpu(kit, out, *arguments, **environment):
    command = [sys.executable, "-B", kit / "try_gpu.py", out, *arguments, "--driver", FAKE]
    done = subprocess.run(command, capture_output=True, text=True, timeout=900, cwd="/", env=environment)
    return done, json.loads((out / "result.json").read_text())


def test_the_kit_tells_that_kernels_run_and_are_right_and_what_they_take(kit, tmp_path):
    stages = ("devices", "act", "kernels", "sanitizer", "cases", "families", "ways", "products")
    done, found = try_gpu(kit, tmp_path, *stages, "--families", "smolvla", "--model", "h100", PATH="/usr/bin:/bin")
    assert done.returncode == 0, done.stdout + done.stderr
    assert found["card"] == "a GPU of tests" and found["driver"].startswith("driver for CUDA")
    checks = found["checks"]
    assert all(one["passed"] for one in checks.values())
    assert {"cuda:0", "act in float32 beside the CPU's", "act in int8 beside the CPU's", "act in int4 beside the CPU's", "tests of kernels", "golden cases", "products"} <= set(checks)
    assert found["cases"] == {"passed": 2, "failed": []}
    family = found["families"]["smolvla"]
    assert family["stored"]["ms"]["network"] > 0 and family["int8"]["ms"]["network"] > 0
    assert all(family["ways"][way]["ms"]["network"] > 0 for way in ("without clusters", "without halved-norms", "with flash", "with tma"))
    assert family["predicted"]["model"] == "h100" and family["predicted"]["ms"]["steps"] > 0
    assert {row["kind"] for row in found["products"]} == {"bf16", "ternary", "int4", "int8"}
    assert {row["kernel"] for row in found["attention"]} >= {"attention_bf16_64", "attention_f32"}
    with pytest.raises(SystemExit, match="driver of tests"):
        gpu_table.keep(tmp_path, tmp_path / "result.json")


def test_a_failing_driver_ends_the_kit_with_each_of_its_calls(kit, tmp_path):
    done, found = try_gpu(kit, tmp_path, "devices", "act", "products", PATH="/usr/bin:/bin", VLA_FAKE_FAILS_AT="60")
    assert done.returncode == 1
    assert not found["checks"]["act in float32"]["passed"] and "CUDA_ERROR" in found["checks"]["act in float32"]["said"]
    assert "products" not in found["checks"]
    assert any(line.startswith("cuGraphLaunch: ok") for line in found["probe"])

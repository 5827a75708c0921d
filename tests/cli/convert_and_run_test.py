# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""From a checkpoint folder to actions, by the two commands that a user types."""

import subprocess
import sys

import numpy as np
import pytest
from conftest import ROOT
from golden_cases import FLOAT32, NAMES, Golden, tensors


def convert(case, out, dtype):
    """vla-convert of the package beside these tests, as a process of its own."""
    checkpoint = case.folder / "checkpoint"
    backbone = [p for p in (checkpoint / "vlm", checkpoint / "tokenizer") if p.is_dir()]
    command = [
        sys.executable,
        "-m",
        "vla_cpp.convert.cli",
        checkpoint,
        *(["--backbone", backbone[0]] if backbone else []),
        "-o",
        out,
        "--dtype",
        dtype,
        *case.conversion(),
    ]
    result = subprocess.run(command, cwd=ROOT / "python", capture_output=True, text=True, timeout=120)
    assert result.returncode == 0, result.stderr
    return out


@pytest.mark.parametrize("name", NAMES)
def test_a_golden_checkpoint_becomes_the_committed_bundle_byte_for_byte(tmp_path, name):
    case = Golden(name)
    assert convert(case, tmp_path / "policy.gguf", "bf16").read_bytes() == case.bundle.read_bytes()


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("dtype", ["f32", "bf16"])
def test_a_converted_checkpoint_gives_the_references_chunk_within_1e_5(vla, tmp_path, name, dtype):
    case, taps = Golden(name), tmp_path / "taps.gguf"
    bundle = convert(case, tmp_path / "policy.gguf", dtype)
    answer = vla(*case.arguments(bundle=bundle, options=["--json", "--tap", "chunk", "--taps-out", taps, *FLOAT32])).json()
    assert answer["bundle"]["dtype"] == dtype
    expected = tensors(case.expected)
    for got, name in ((tensors(taps)["chunk"], "chunk"), (np.array(answer["actions"]), "actions")):
        assert np.abs(got - expected[name]).max() <= 1e-5 * np.abs(expected[name]).max()

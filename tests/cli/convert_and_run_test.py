# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""From a checkpoint folder to actions: vla-convert, then vla run."""

import numpy as np
import pytest
from golden_cases import FLOAT32, NAMES, Golden, tensors
from program import IS_SANITIZED

from vla_cpp.convert import cli

pytestmark = pytest.mark.skipif(IS_SANITIZED, reason="a sanitizer does not watch the converter, and its bundles are those of other tests")


def convert(case, out, dtype):
    checkpoint = case.folder / "checkpoint"
    backbone = [p for p in (checkpoint / "vlm", checkpoint / "tokenizer") if p.is_dir()]
    options = ["--backbone", backbone[0]] if backbone else []
    arguments = [checkpoint, *options, "-o", out, "--dtype", dtype, "--quiet", *case.conversion()]
    assert cli.main([str(argument) for argument in arguments]) == 0
    return out


@pytest.mark.parametrize("name", NAMES)
def test_a_golden_checkpoint_becomes_the_committed_bundle_byte_for_byte(tmp_path, name):
    case = Golden(name)
    assert convert(case, tmp_path / "policy.gguf", "bf16").read_bytes() == case.bundle.read_bytes()


@pytest.mark.parametrize("name", NAMES)
def test_a_checkpoint_converted_in_float32_gives_the_references_chunk_within_1e_5(vla, tmp_path, name):
    """As the committed bundle, of bf16, does in run_test.py."""
    case, taps = Golden(name), tmp_path / "taps.gguf"
    bundle = convert(case, tmp_path / "policy.gguf", "f32")
    answer = vla(*case.arguments(bundle=bundle, options=["--json", "--tap", "chunk", "--taps-out", taps, *FLOAT32])).json()
    assert answer["bundle"]["dtype"] == "f32"
    expected = tensors(case.expected)
    for got, name in ((tensors(taps)["chunk"], "chunk"), (np.array(answer["actions"]), "actions")):
        assert np.abs(got - expected[name]).max() <= 1e-5 * np.abs(expected[name]).max()

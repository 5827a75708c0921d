# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""--dtype int8 and int4: the bytes of `vla quantize` on what a conversion without --dtype gives."""

import os
import subprocess
from pathlib import Path

import pytest
import tiny as sizes
from manifests import vla
from vla_cpp.convert import ConvertError, Options, convert_checkpoint
from vla_cpp.convert.cli import report
from vla_cpp.convert.errors import Code


@pytest.fixture(autouse=True)
def program(monkeypatch):
    monkeypatch.setenv("VLA_BINARY", vla())


@pytest.fixture
def wide(monkeypatch):
    """A checkpoint with matrices that are large enough to become codes."""
    monkeypatch.setattr(sizes, "D_VISION", 160)
    monkeypatch.setattr(sizes, "D_VISION_FF", 192)
    checkpoint = sizes.Tiny()
    checkpoint.backbone["vision_config"].update(hidden_size=160, intermediate_size=192)
    return checkpoint


@pytest.mark.parametrize("dtype", ["int8", "int4"])
def test_codes_are_those_of_vla_quantize(converter, wide, tmp_path, dtype):
    converter.save(wide)
    summary = convert_checkpoint(str(converter.folder), converter.out, Options(dtype=dtype))
    stored, expected = str(tmp_path / "stored.gguf"), str(tmp_path / "expected.gguf")
    convert_checkpoint(str(converter.folder), stored, Options())
    subprocess.run([vla(), "quantize", stored, "-o", expected, "--dtype", dtype, "--quiet"], check=True)
    assert Path(converter.out).read_bytes() == Path(expected).read_bytes()
    assert os.path.getsize(converter.out) == summary.n_bytes < os.path.getsize(stored)
    assert "{}: smolvla, ".format(converter.out) in report(summary) and " {}, ".format(dtype) in report(summary)
    assert sorted(os.listdir(tmp_path)) == ["expected.gguf", "out.gguf", "policy", "stored.gguf"]


def test_a_policy_without_large_matrices_is_refused_with_what_vla_quantize_says(converter, tiny):
    refusal = converter.refusal(tiny, dtype="int8")
    assert "large matrices of floats, found none" in refusal.message()
    assert sorted(os.listdir(os.path.dirname(converter.out))) == ["policy"]


def test_without_the_program_nothing_is_converted(converter, tiny, monkeypatch):
    monkeypatch.setenv("VLA_BINARY", "/nowhere/vla")
    refusal = converter.refusal(tiny, dtype="int4")
    assert refusal.code == Code.IO and "/nowhere/vla" in refusal.message() and "VLA_BINARY" in refusal.message()


def test_an_existing_bundle_is_refused_before_anything_is_read(converter, wide):
    converter.save(wide)
    Path(converter.out).write_bytes(b"mine")
    with pytest.raises(ConvertError, match="--force"):
        convert_checkpoint(str(converter.folder), converter.out, Options(dtype="int8"))
    assert Path(converter.out).read_bytes() == b"mine"
    convert_checkpoint(str(converter.folder), converter.out, Options(dtype="int8"), force=True)
    assert Path(converter.out).read_bytes().startswith(b"GGUF")

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Every bundle that is damaged, foreign or of another make is one typed error of `run` and `inspect` alike."""

import os
import struct

import pytest
from golden_cases import data_offset, replaced, sealed, with_integer
from program import EXIT, IS_SANITIZED


@pytest.fixture
def refused(vla, golden, tmp_path):
    """Writes bytes as a bundle; both commands must refuse them in the same words."""

    def check(data, code, *parts):
        path = tmp_path / "policy.gguf"
        path.write_bytes(data)
        answers = [vla(*golden.arguments(bundle=path)), vla("inspect", path)]
        assert answers[0].err == answers[1].err
        return answers[0].refused(code, *parts)

    return check


@pytest.fixture
def sound(golden):
    return golden.bundle.read_bytes()


@pytest.mark.parametrize("size", [1, 4, 23, 24, 1000, 20_000, 100_000, -32, -1])
def test_a_truncated_bundle_is_refused(refused, sound, size):
    refused(sound[:size], "bad_bundle")


def test_an_empty_bundle_is_refused(refused):
    refused(b"", "bad_bundle", "found an empty file")


def test_a_truncated_bundle_says_so_and_what_to_do(refused, sound):
    refused(sound[:-32], "bad_bundle", "the file is truncated: copy or convert it again")


@pytest.mark.parametrize("place", [0, 5, 9, 17, 40, 5_000, 15_000, 50_000, -1])
def test_a_bundle_with_one_flipped_bit_is_refused(refused, sound, place):
    damaged = bytearray(sound)
    damaged[place] ^= 4
    refused(bytes(damaged), "bad_bundle")


def test_a_flipped_weight_is_a_checksum_that_does_not_fit(refused, sound):
    damaged = bytearray(sound)
    damaged[-100_000] ^= 4
    refused(bytes(damaged), "bad_bundle", "expected content with checksum xxh3:", "damaged or edited")


@pytest.mark.parametrize("version, hint", [(0, "run vla-convert again"), (2, "this bundle needs a newer vla")])
def test_another_bundle_version_is_refused_with_the_next_move(refused, sound, version, hint):
    changed = sealed(with_integer(sound, "vla.bundle_version", version))
    refused(changed, "bad_bundle", f"vla.bundle_version: expected 1, found {version}; {hint}")


def test_another_version_of_gguf_is_refused(refused, sound):
    refused(sound[:4] + struct.pack("<I", 2) + sound[8:], "bad_bundle", "expected GGUF version 3, found version 2")


def test_an_image_is_not_a_bundle(refused, golden):
    refused(golden.images["camera1"].read_bytes(), "bad_bundle", "expected a GGUF file, found other first bytes")


def test_a_gguf_file_of_another_kind_is_not_a_bundle(refused, golden):
    refused(golden.expected.read_bytes(), "bad_bundle", "expected a vla bundle, found a GGUF file of another kind")


def test_a_bundle_that_claims_a_terabyte_of_keys_is_refused_at_once(refused, sound):
    answer = refused(sound[:16] + struct.pack("<Q", 1 << 40) + sound[24:], "bad_bundle")
    assert answer.seconds < 10 and answer.peak < 1 << 29


def test_an_architecture_that_this_build_does_not_know_is_unsupported(refused, sound):
    at = sound.index(b"vla.arch") + 8 + 4 + 8
    refused(sealed(sound[:at] + b"groovla" + sound[at + 7 :]), "unsupported", "expected one of ", "smolvla", "found groovla; this build")


def test_a_renamed_tensor_is_reported_as_missing_and_as_unused(vla, golden, sound, tmp_path):
    path = tmp_path / "policy.gguf"
    path.write_bytes(sealed(replaced(sound, b"expert.norm.weight", b"expert.gnom.weight")))
    answer = vla(*golden.arguments(bundle=path))
    assert answer.code == EXIT["bad_bundle"] and answer.out == ""
    assert answer.err.startswith(f"error: bad_bundle: {path}: does not fit policy smolvla: 2 problems\n")
    assert "missing tensor  expert.norm.weight" in answer.err and "unused tensor   expert.gnom.weight" in answer.err


def test_a_size_that_does_not_fit_its_tensors_is_reported_with_both_shapes(vla, golden, sound, tmp_path):
    path = tmp_path / "policy.gguf"
    path.write_bytes(sealed(with_integer(sound, "lm.d_ff", 57)))
    answer = vla(*golden.arguments(bundle=path))
    assert answer.code == EXIT["bad_bundle"] and answer.out == ""
    assert "wrong shape     lm.blk.0.ffn_up.weight" in answer.err
    assert "expected [48, 57], file has [48, 56]" in answer.err


def test_statistics_that_are_not_finite_are_refused(refused, golden, sound):
    at = data_offset(golden.bundle, "stats.action.std")
    changed = sealed(sound[:at] + struct.pack("<f", float("nan")) + sound[at + 4 :])
    refused(changed, "bad_bundle", "stats.action.std: expected finite numbers, found nan")


def test_a_weight_that_is_not_finite_is_a_bad_action_and_never_a_number(vla, golden, sound, tmp_path):
    at = data_offset(golden.bundle, "action_out.bias")
    path = tmp_path / "policy.gguf"
    path.write_bytes(sealed(sound[:at] + struct.pack("<f", float("inf")) + sound[at + 4 :]))
    vla(*golden.arguments(bundle=path)).refused("bad_action", 'actions[0]["action.0"]: expected a finite number')


def with_image_size(data, size):
    old, new = b'"width": 32, "height": 32, "filter": "bilinear"', b'"width":%d,"height":%d,"filter":"bilinear"'
    return sealed(replaced(data, old, (new % (size, size)).ljust(len(old))))


def test_an_image_size_beyond_any_attention_is_refused_at_once(refused, sound):
    answer = refused(with_image_size(sound, 8192), "unsupported", "expected at most 8192 tokens")
    assert answer.seconds < 10 and answer.peak < 1 << 29


@pytest.mark.skipif(IS_SANITIZED, reason="a sanitizer needs more address space than any limit leaves")
def test_an_image_size_that_memory_cannot_hold_is_out_of_memory(vla, golden, sound, tmp_path):
    path = tmp_path / "policy.gguf"
    path.write_bytes(with_image_size(sound, 960))
    for arguments in (golden.arguments(bundle=path), ["inspect", path]):
        answer = vla(*arguments, memory=1 << 28)
        assert answer.code == EXIT["out_of_memory"] and answer.out == ""
        assert answer.err.startswith("error: out_of_memory: ") and answer.err.count("\n") == 1, answer.err


def test_a_missing_bundle_is_an_io_error_with_its_path(vla, golden, tmp_path):
    path = tmp_path / "nothing.gguf"
    vla(*golden.arguments(bundle=path)).refused("io", f"{path}: expected a readable bundle, found No such file")


def test_a_folder_is_not_a_bundle(vla, golden, tmp_path):
    vla(*golden.arguments(bundle=tmp_path)).refused("io", "something that is not a regular file")


def test_a_pipe_without_a_writer_is_refused_and_not_waited_for(vla, golden, tmp_path):
    os.mkfifo(tmp_path / "pipe")
    answer = vla(*golden.arguments(bundle=tmp_path / "pipe"), limit=20)
    answer.refused("io", "something that is not a regular file")

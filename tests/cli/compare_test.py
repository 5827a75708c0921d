# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""vla compare: the verdict on recorded taps, in print and as an exit code."""

import struct

import numpy as np
import pytest
from golden_cases import FLOAT32, NAMES, Golden, data_offset, tensors
from program import EXIT, every_third_if_sanitized


@pytest.fixture(scope="module")
def taps(vla, tmp_path_factory):
    """Everything that a run of two_views computes."""
    path, case = tmp_path_factory.mktemp("taps") / "got.gguf", Golden("two_views")
    assert vla(*case.arguments(options=["--json", "--tap", "*", "--taps-out", path, *FLOAT32])).code == 0
    return path


@pytest.fixture
def doctored(taps, tmp_path):
    """The same with the first number of some taps changed."""

    def change(value, *names):
        data = bytearray(taps.read_bytes())
        for name in names:
            struct.pack_into("<f", data, data_offset(taps, name), value)
        (tmp_path / "doctored.gguf").write_bytes(data)
        return tmp_path / "doctored.gguf"

    return change


@pytest.mark.parametrize("name", every_third_if_sanitized(NAMES, 2))
def test_every_block_of_a_golden_case_agrees_with_the_reference_within_1e_5(vla, tmp_path, name):
    case = Golden(name)
    assert vla(*case.arguments(options=["--tap", "*", "--taps-out", tmp_path / "got.gguf", *FLOAT32])).code == 0
    answer = vla("compare", case.expected, tmp_path / "got.gguf", "--tolerance", "1e-5")
    assert answer.code == 0 and answer.err == "", answer.out
    compared = [line.split()[0] for line in answer.out.splitlines()[1:-1]]
    missed = set(tensors(case.expected)) - set(compared)
    assert all(n.endswith(".bf16") or n == "position_ids" for n in missed), missed
    assert f"{len(compared)} of {len(compared)} taps within 1e-05; {len(missed)} of" in answer.out


def test_taps_are_listed_in_the_order_in_which_the_reference_computes_them(vla, golden, taps):
    listed = [line.split()[0] for line in vla("compare", golden.expected, taps).out.splitlines()[1:-1]]
    order = [name for name in tensors(golden.expected) if name in listed]
    assert listed == order and listed.index("vision.patch_embed") < listed.index("vision.blk.0") < listed.index("chunk")


def test_a_doctored_tap_fails_and_the_first_one_is_where_to_start(vla, golden, taps, doctored):
    answer = vla("compare", golden.expected, doctored(1e3, "lm.blk.1", "chunk"))
    assert answer.code == EXIT["mismatch"]
    rows = {line.split()[0]: line for line in answer.out.splitlines()[1:-1]}
    assert rows["lm.blk.1"].endswith("FAIL  <- start here") and rows["chunk"].endswith("FAIL")
    assert sum("FAIL" in row for row in rows.values()) == 2 and rows["lm.blk.0"].endswith("ok")
    assert answer.err.startswith("error: mismatch: lm.blk.1: expected a relative difference of at most 0.0001, found ")
    assert answer.err.count("\n") == 1 and "2 of" in answer.err


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_number_that_is_not_finite_never_agrees(vla, golden, doctored, value):
    answer = vla("compare", golden.expected, doctored(value, "chunk"), "--tolerance", "1e30")
    assert answer.code == EXIT["mismatch"] and "FAIL (shape, or not finite)" in answer.out


def test_only_the_taps_that_a_pattern_names_are_compared(vla, golden, doctored):
    got = doctored(1e3, "lm.blk.1")
    assert vla("compare", golden.expected, got, "--only", "vision.*,chunk").code == 0
    assert vla("compare", golden.expected, got, "--only", "lm.*").code == EXIT["mismatch"]


def test_a_tolerance_decides(vla, golden, doctored):
    got = doctored(float(tensors(golden.expected)["chunk"].flat[0]) + 1e-3, "chunk")
    assert vla("compare", golden.expected, got, "--tolerance", "1e-2").code == 0
    assert vla("compare", golden.expected, got, "--tolerance", "1e-4").code == EXIT["mismatch"]


def test_a_pattern_records_only_what_it_names(vla, golden, tmp_path):
    assert vla(*golden.arguments(options=["--tap", "lm.blk.*,chunk", "--taps-out", tmp_path / "few.gguf"])).code == 0
    recorded = set(tensors(tmp_path / "few.gguf"))
    assert {"lm.blk.0", "lm.blk.1", "chunk"} < recorded
    assert all(name.startswith("lm.blk.") or name == "chunk" for name in recorded)


def test_recording_changes_the_chunk_by_rounding_at_most(vla, golden, tmp_path):
    plain = np.array(vla(*golden.arguments(options=["--json", *FLOAT32])).json()["actions"])
    recording = ["--tap", "*", "--taps-out", tmp_path / "t.gguf"]
    recorded = vla(*golden.arguments(options=["--json", *recording, *FLOAT32])).json()["actions"]
    # A recorded value is computed apart from the one that it would be fused with: the same numbers, rounded once more.
    assert np.abs(plain - recorded).max() <= 2e-6 * np.abs(plain).max()


def test_files_without_a_common_tap_are_a_mismatch(vla, golden, tmp_path):
    vla(*golden.arguments(options=["--tap", "actions", "--taps-out", tmp_path / "a.gguf"]))
    vla(*golden.arguments(options=["--tap", "chunk", "--taps-out", tmp_path / "c.gguf"]))
    vla("compare", tmp_path / "a.gguf", tmp_path / "c.gguf").refused(
        "mismatch", "expected taps that stand in both files, found none"
    )


def test_a_pattern_that_names_no_tap_is_refused_and_writes_nothing(vla, golden, tmp_path):
    answer = vla(*golden.arguments(options=["--json", "--tap", "lm.block.*", "--taps-out", tmp_path / "t.gguf"]))
    answer.refused("usage", "--tap: expected a pattern that names")
    assert not (tmp_path / "t.gguf").exists()


def test_files_that_are_no_taps_are_refused(vla, golden, taps, tmp_path):
    vla("compare", golden.expected, golden.noise).refused("bad_bundle", "expected a GGUF file")
    vla("compare", golden.expected, golden.bundle).refused("bad_bundle", "expected f32, found bf16")
    vla("compare", tmp_path / "nothing.gguf", taps).refused("io", "nothing.gguf")
    vla("compare", golden.expected, tmp_path).refused("io", "something that is not a regular file")
    (tmp_path / "cut.gguf").write_bytes(taps.read_bytes()[:-64])
    vla("compare", golden.expected, tmp_path / "cut.gguf").refused("bad_bundle", "truncated")

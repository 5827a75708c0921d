# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The header reader on hostile and truncated files."""

import json
import struct
import time

import numpy as np
import pytest
from safetensors.numpy import save_file

from vla_cpp.convert import Code, ConvertError
from vla_cpp.convert.errors import Problems
from vla_cpp.convert.safetensors_file import MAX_HEADER, MAX_TENSORS, read_safetensors

GOOD = {
    "a": {"dtype": "F32", "shape": [2, 3], "data_offsets": [0, 24]},
    "b": {"dtype": "BF16", "shape": [4], "data_offsets": [24, 32]},
}


def write(path, header, data=32, length=None):
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    path.write_bytes(struct.pack("<Q", len(text) if length is None else length) + text + bytes(data))
    return str(path)


def changed(**fields):
    return {**GOOD, "b": {**GOOD["b"], **fields}}


def test_more_tensors_than_any_policy_has_are_refused_before_they_are_made(tmp_path):
    header = {"t{}".format(i): {"dtype": "F32", "shape": [0], "data_offsets": [0, 0]} for i in range(300_000)}
    path, before = write(tmp_path / "f", header, data=0), time.process_time()
    with pytest.raises(ConvertError, match="expected at most {} tensors, found 300000".format(MAX_TENSORS)):
        read_safetensors(path)
    assert time.process_time() - before < 1


def test_a_file_of_the_formats_own_library_is_read_back(tmp_path):
    rng = np.random.default_rng(0)
    tensors = {
        "x": rng.standard_normal((3, 5)).astype(np.float32),
        "y": rng.standard_normal(7).astype(np.float16),
        "empty": np.zeros((0, 4), np.float32),
    }
    save_file(tensors, str(tmp_path / "f"), metadata={"format": "pt"})
    content = read_safetensors(str(tmp_path / "f"))
    assert content.metadata == {"format": "pt"}
    for name, value in tensors.items():
        entry = content.entries[name]
        assert entry.shape == value.shape
        parts = list(entry.chunks(8))
        assert all(part.nbytes <= 8 for part in parts)
        np.testing.assert_array_equal(np.concatenate(parts or [np.zeros(0, value.dtype)]), value.ravel())


def test_the_well_formed_header_of_these_tests_is_accepted(tmp_path):
    assert set(read_safetensors(write(tmp_path / "f", GOOD)).entries) == {"a", "b"}


@pytest.mark.parametrize("size", range(9))
def test_a_file_shorter_than_its_header_is_refused(tmp_path, size):
    (tmp_path / "f").write_bytes(struct.pack("<Q", 100)[:size] + b"x" * max(0, size - 8))
    with pytest.raises(ConvertError, match="a safetensors header inside the file"):
        read_safetensors(str(tmp_path / "f"))


@pytest.mark.parametrize("cut", [1, 8, 31, 32])
def test_missing_data_is_refused(tmp_path, cut):
    with pytest.raises(ConvertError, match="truncated"):
        read_safetensors(write(tmp_path / "f", GOOD, data=32 - cut))


HOSTILE = {
    "a header of 4611686018427387904 bytes": dict(header=GOOD, length=1 << 62),
    "expected a safetensors header in JSON": dict(header=b"{" + b" " * 40),
    "the name a stands twice": dict(header=b'{"a":1,"a":2}'),
    "that is a JSON object, found list": dict(header=[]),
    "expected dtype, shape and data_offsets, found 7": dict(header={"b": 7}),
    "expected dtype, shape and data_offsets, found {'dtype": dict(header=changed(extra=1)),
    "expected a dtype of the safetensors format, found F7": dict(header=changed(dtype="F7")),
    "expected a dtype of the safetensors format, found \\['F32'\\]": dict(header=changed(dtype=["F32"])),
    "expected a shape of at most 8 counts, found \\[-4\\]": dict(header=changed(shape=[-4])),
    "expected a shape of at most 8 counts, found \\[True": dict(header=changed(shape=[True, 4])),
    "expected a shape of at most 8 counts, found \\[4.0": dict(header=changed(shape=[4.0])),
    "expected a shape of at most 8 counts, found \\[1, 1": dict(header=changed(shape=[1] * 9)),
    "expected two data offsets, found \\[24\\]": dict(header=changed(data_offsets=[24])),
    "expected two data offsets, found \\['24'": dict(header=changed(data_offsets=["24", "32"])),
    "expected 8 bytes for \\[4\\] of BF16, found 10 bytes": dict(header=changed(data_offsets=[22, 32])),
    "expected 8 bytes for \\[4\\] of BF16, found -8 bytes": dict(header=changed(data_offsets=[32, 24])),
    "expected data at byte .*, found byte": dict(header=changed(data_offsets=[16, 24])),
    "expected a file of .* bytes, found": dict(header=GOOD, data=40),
    "expected .* bytes for .2305843009213693952, 2305843009213693952. of BF16": dict(
        header=changed(shape=[1 << 61, 1 << 61])
    ),
    "__metadata__: expected a JSON object of strings": dict(header={**GOOD, "__metadata__": {"format": 1}}),
}


@pytest.mark.parametrize("message", HOSTILE)
def test_a_hostile_header_is_refused(tmp_path, message):
    with pytest.raises(ConvertError, match=message) as info:
        read_safetensors(write(tmp_path / "f", **HOSTILE[message]))
    assert info.value.code == Code.BAD_BUNDLE


def test_a_header_above_the_formats_limit_is_refused_without_reading_it(tmp_path):
    with open(tmp_path / "f", "wb") as file:
        file.write(struct.pack("<Q", MAX_HEADER + 1))
        file.truncate(MAX_HEADER + 1000)  # sparse
    with pytest.raises(ConvertError, match="a safetensors header inside the file"):
        read_safetensors(str(tmp_path / "f"))


def test_random_damage_to_a_header_never_escapes_as_another_exception(tmp_path):
    rng = np.random.default_rng(7)
    good = (tmp_path / "good").absolute()
    write(good, GOOD)
    data = bytearray(good.read_bytes())
    refused = 0
    for _ in range(500):
        broken = bytearray(data)
        for position in rng.integers(0, len(data) - 32, rng.integers(1, 4)):
            broken[position] = rng.integers(0, 256)
        (tmp_path / "f").write_bytes(bytes(broken))
        try:
            read_safetensors(str(tmp_path / "f"))
        except ConvertError:
            refused += 1
    assert refused > 300


def test_a_name_that_stands_twice_among_many_is_found_at_once(tmp_path):
    names = ['"{}":1'.format(i) for i in range(50_000)] + ['"49999":1']
    start = time.process_time()  # of this process alone, however busy the machine is
    with pytest.raises(ConvertError, match="the name 49999 stands twice"):
        read_safetensors(write(tmp_path / "x.safetensors", ("{" + ",".join(names) + "}").encode()))
    assert time.process_time() - start < 5


def test_a_report_of_very_many_problems_has_fifty_lines_and_a_count():
    problems = Problems("policy")
    for i in range(20_000):
        problems.add("tensor {}".format(i), "no such tensor", "one")
    with pytest.raises(ConvertError) as info:
        problems.raise_any()
    lines = info.value.message().splitlines()
    assert (lines[0], lines[-1], len(lines)) == ("policy: 20000 problems", "  and 19950 more", 52)

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The file itself: readable by GGUF's own tools, checksummed, deterministic, complete or absent, written in bounded memory."""

import json
import os
import shutil
import struct
import subprocess
import sys

import numpy as np
import pytest
import xxhash
from gguf import GGUFReader

from vla_cpp.convert import ConvertError, read_bundle
from vla_cpp.convert.bundle import BundleWriter, Key, TensorInfo

KEYS = [
    Key("general.architecture", "string", "vla"),
    Key("n", "u32", 7),
    Key("x", "f32", 0.1),
    Key("y", "f64", 0.1),
    Key("yes", "bool", True),
    Key("list", "u32[]", [1, 2**32 - 1]),
    Key("words", "string[]", ["", "\u0120x", "\U0001f642"]),
    Key("none", "string[]", []),
]


def write(path, tensors=()):
    with BundleWriter(str(path), KEYS, [TensorInfo(name, value.shape, dtype) for name, dtype, value in tensors]) as out:
        for name, _, value in tensors:
            out.write(name, value)
    return str(path)


def some_tensors():
    rng = np.random.default_rng(0)
    return [
        ("a", "f32", rng.standard_normal((3, 5)).astype(np.float32)),
        ("b", "bf16", rng.integers(0, 1 << 15, (2, 3, 7)).astype(np.uint16)),
        ("c", "f16", rng.standard_normal(1).astype(np.float16)),
    ]


def test_values_of_every_type_are_read_back_by_the_formats_own_reader(tmp_path):
    reader = GGUFReader(write(tmp_path / "b.gguf", some_tensors()))
    keys = {name: field.contents() for name, field in reader.fields.items()}
    assert keys["n"] == 7 and keys["y"] == 0.1 and keys["x"] == np.float32(0.1) and keys["yes"] is True
    assert list(keys["list"]) == [1, 2**32 - 1] and keys["words"] == ["", "\u0120x", "\U0001f642"]
    assert [tensor.name for tensor in reader.tensors] == ["a", "b", "c"]
    assert [int(dim) for dim in reader.tensors[1].shape] == [7, 3, 2]


def test_tensors_are_read_back_bit_by_bit(tmp_path):
    content = read_bundle(write(tmp_path / "b.gguf", some_tensors()))
    for name, dtype, value in some_tensors():
        assert content.dtypes[name] == dtype
        np.testing.assert_array_equal(content.tensors[name], value)


def test_the_checksum_is_xxh3_of_the_file_with_its_digits_as_zeros(tmp_path):
    data = open(write(tmp_path / "b.gguf", some_tensors()), "rb").read()
    at = data.index(b"xxh3:") + 5
    stated = data[at : at + 16].decode()
    assert stated == "{:016x}".format(xxhash.xxh3_64_intdigest(data[:at] + b"0" * 16 + data[at + 16 :]))


def test_a_flipped_bit_is_noticed_wherever_it_is(tmp_path):
    path = write(tmp_path / "b.gguf", some_tensors())
    data = open(path, "rb").read()
    for position in range(len(data)):
        broken = bytearray(data)
        broken[position] ^= 1
        open(path, "wb").write(bytes(broken))
        with pytest.raises(ConvertError, match="content with checksum"):
            read_bundle(path)


def test_every_tensor_starts_aligned_and_the_file_ends_with_padding(tmp_path):
    path = write(tmp_path / "b.gguf", some_tensors())
    assert all(int(tensor.data_offset) % 32 == 0 for tensor in GGUFReader(path).tensors)
    assert os.path.getsize(path) % 32 == 0


def test_a_bundle_that_is_not_finished_never_appears(tmp_path):
    path = str(tmp_path / "b.gguf")
    with pytest.raises(RuntimeError):
        with BundleWriter(path, KEYS, [TensorInfo("a", (4,), "f32")]) as out:
            out.write("a", np.zeros(2, np.float32))
            raise RuntimeError("interrupted")
    assert os.listdir(tmp_path) == []


def test_a_bundle_with_missing_data_is_not_finished(tmp_path):
    with pytest.raises(AssertionError, match="8 bytes missing"):
        with BundleWriter(str(tmp_path / "b.gguf"), KEYS, [TensorInfo("a", (4,), "f32")]) as out:
            out.write("a", np.zeros(2, np.float32))
    assert os.listdir(tmp_path) == []


def test_a_failed_conversion_leaves_the_old_bundle_in_place(converter, tiny):
    converter.bundle(tiny)
    before = open(converter.out, "rb").read()
    tiny.tensors["model.action_out_proj.bias"][0] = np.nan
    with pytest.raises(ConvertError, match="finite"):
        converter.bundle(tiny)
    assert open(converter.out, "rb").read() == before


def test_the_same_checkpoint_gives_the_same_bytes_wherever_it_lies(converter, tiny, tmp_path):
    converter.bundle(tiny)
    first = open(converter.out, "rb").read()
    (tmp_path / "deeper").mkdir()
    shutil.move(str(converter.folder), str(tmp_path / "deeper" / "policy"))
    converter.folder, converter.out = tmp_path / "deeper" / "policy", str(tmp_path / "deeper" / "other.gguf")
    converter.bundle()
    assert open(converter.out, "rb").read() == first


def test_the_order_of_tensors_in_the_checkpoint_does_not_matter(converter, tiny):
    converter.bundle(tiny)
    first = open(converter.out, "rb").read()
    tiny.tensors = dict(reversed(list(tiny.tensors.items())))
    converter.bundle(tiny)
    assert open(converter.out, "rb").read() == first


MEASURE = """
import json, resource, sys
from vla_cpp.convert import Options, convert_checkpoint
base = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
convert_checkpoint(sys.argv[1], sys.argv[2], Options(), force=True)
print(json.dumps([base, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss]))
"""


def test_memory_does_not_grow_with_the_size_of_a_tensor(converter, tiny):
    """A 96 MB table must not show: the promise is 1.5 times the largest tensor plus 500 MB, streaming needs far less."""
    rows = 2_000_000
    tiny.backbone["text_config"]["vocab_size"] = rows
    for name in (
        "model.vlm_with_expert.vlm.model.text_model.embed_tokens.weight",
        "model.vlm_with_expert.vlm.lm_head.weight",
    ):
        tiny.tensors[name] = np.ones((rows, 12), np.float32)
    folder = converter.save(tiny)
    package = os.path.join(os.path.dirname(__file__), "..", "..", "python")
    result = subprocess.run(
        [sys.executable, "-c", MEASURE, folder, converter.out],
        env={**os.environ, "PYTHONPATH": package},
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stderr
    before, peak = json.loads(result.stdout)
    assert os.path.getsize(converter.out) > rows * 12 * 4
    assert (peak - before) * 1024 < 80e6  # kilobytes on Linux


def test_the_header_states_version_three(tmp_path):
    assert struct.unpack("<4sI", open(write(tmp_path / "b.gguf"), "rb").read(8)) == (b"GGUF", 3)

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""`vla quantize`: a bundle of codes gives the actions that --kernels int8 or int4 makes of the floats, and float32 those of its codes."""

import numpy as np
import pytest

from bundle_keys import bundle_keys
from golden_cases import ROOT, data_offset, sealed
from vla_cpp.convert.bundle import BundleWriter, TensorInfo, read_bundle

SHIPPED = ROOT / "models/metaworld-tiny.gguf"
MATRIX = "vision.blk.0.attn_q.weight"
FEW_ROWS = 144  # matrices from or to fewer elements stay as they are


@pytest.fixture(scope="module")
def bundles(vla, tmp_path_factory):
    folder = tmp_path_factory.mktemp("quantized")
    for dtype in ("int8", "int4"):
        answer = vla("quantize", SHIPPED, "-o", folder / f"{dtype}.gguf", "--dtype", dtype)
        assert answer.code == 0, answer.err
        assert "matrices" in answer.out and "all" in answer.out
    return folder


@pytest.fixture
def quantized(bundles):
    return bundles / "int8.gguf"


@pytest.fixture(scope="module")
def actions(vla):
    frame = ROOT / "examples/metaworld/episodes"
    image = sorted(frame.rglob("*.png"))[0]

    def run(bundle, *options):
        answer = vla("run", bundle, "--image", f"corner4={image}", "--state", "0,0.4,0.2,1", "--text", "open the faucet",
                     "--seed", "3", "--threads", "2", "--json", *options)
        return np.array(answer.json()["actions"]), answer.json()

    return run


def widened(codes, scales):
    return codes.astype(np.float32) * scales[:, None]


def whole_numbers(blocks, d_in):
    """Those of int4 blocks: 33 bytes for 64 elements, a step and then two codes a byte; zeros behind the end of a row."""
    rows, width = blocks.shape
    blocks = blocks.view(np.uint8).reshape(rows, width // 33, 33)
    codes = np.stack([blocks[:, :, 1:] & 15, blocks[:, :, 1:] >> 4], axis=-1).astype(np.int32) - 8
    numbers = (codes.reshape(rows, width // 33, 64) * blocks[:, :, :1]).reshape(rows, -1)
    assert not numbers[:, d_in:].any()
    return numbers[:, :d_in]


def codes_of(content, name, width):
    codes = content.tensors[name]
    return codes if codes.shape[1] == width else whole_numbers(codes, width)


def test_large_matrices_become_codes_and_the_rest_stays(quantized):
    before, after = read_bundle(str(SHIPPED)), read_bundle(str(quantized))
    for name, values in before.tensors.items():
        large = before.dtypes[name] == "bf16" and values.ndim == 2 and min(values.shape) >= FEW_ROWS and "embed.tokens" not in name
        if after.dtypes[name] != "i8":
            assert np.array_equal(after.tensors[name], values), name
            continue
        assert large, name
        scales = after.tensors[name + "_scale"]
        floats = (values.astype(np.uint32) << 16).view(np.float32)  # of bf16
        assert (np.abs(widened(after.tensors[name], scales) - floats) <= 0.5001 * scales[:, None]).all()
        assert np.array_equal(np.abs(after.tensors[name]).max(axis=1), np.full(len(scales), 127))
    assert list(after.dtypes.values()).count("i8") == 63
    assert quantized.stat().st_size < 0.6 * SHIPPED.stat().st_size


def in_blocks(rows):
    return np.pad(rows, ((0, 0), (0, -rows.shape[1] % 64))).reshape(len(rows), -1, 64)


def test_of_int4_every_block_is_nearer_than_sevenths_of_its_largest(bundles):
    before, after = read_bundle(str(SHIPPED)), read_bundle(str(bundles / "int4.gguf"))
    blocks = [name for name, dtype in after.dtypes.items() if dtype == "i8"]
    assert len(blocks) == 63 and any(before.tensors[name].shape[1] % 64 for name in blocks)
    missed, simple = 0, 0
    for name in blocks:
        floats = (before.tensors[name].astype(np.uint32) << 16).view(np.float32)
        numbers = whole_numbers(after.tensors[name], floats.shape[1])
        assert numbers.shape == floats.shape and np.abs(numbers).max() <= 119
        missed += np.square(floats - widened(numbers, after.tensors[name + "_scale"])).sum()
        floats = in_blocks(floats)
        unit = np.abs(floats).max(-1, keepdims=True) / 7
        simple += np.square(floats - np.rint(floats / unit) * unit).sum()
    assert missed < simple
    assert (bundles / "int4.gguf").stat().st_size < 0.4 * SHIPPED.stat().st_size


@pytest.mark.parametrize("dtype", ["int8", "int4"])
def test_it_gives_the_actions_of_kernels_of_its_dtype_to_the_bit(actions, bundles, dtype):
    asked, _ = actions(SHIPPED, "--kernels", dtype)
    stored, answer = actions(bundles / f"{dtype}.gguf")
    assert np.array_equal(stored, asked)
    assert answer["precision"] == "int8"
    assert not np.array_equal(stored, actions(SHIPPED, "--kernels", "float32")[0])


@pytest.mark.parametrize("dtype", ["int8", "int4"])
@pytest.mark.parametrize("kernels", ["float32", "ggml"])
def test_float32_of_its_codes_is_asked_for_by_name(actions, bundles, tmp_path, kernels, dtype):
    quantized, floats = bundles / f"{dtype}.gguf", read_bundle(str(SHIPPED))
    content = read_bundle(str(quantized))
    keys = [key._replace(value="f32") if key.name == "vla.dtype" else key for key in bundle_keys(quantized)]
    wide = {}
    for name, values in content.tensors.items():
        if content.dtypes[name] == "i8":
            wide[name] = widened(codes_of(content, name, floats.tensors[name].shape[1]), content.tensors[name + "_scale"])
        elif not name.endswith("_scale"):
            wide[name] = values
    dtypes = {name: "f32" if content.dtypes[name] == "i8" else content.dtypes[name] for name in wide}
    tensors = [TensorInfo(name, values.shape, dtypes[name]) for name, values in wide.items()]
    with BundleWriter(str(tmp_path / "wide.gguf"), keys, tensors) as out:
        for name, values in wide.items():
            out.write(name, values)
    assert np.array_equal(actions(quantized, "--kernels", kernels)[0], actions(tmp_path / "wide.gguf", "--kernels", kernels)[0])


def test_a_quantized_bundle_is_not_quantized_again(vla, quantized, tmp_path):
    vla("quantize", quantized, "-o", tmp_path / "again.gguf").refused("unsupported", "quantized already")
    assert not (tmp_path / "again.gguf").exists()


def test_a_file_that_exists_is_kept(vla, quantized):
    before = quantized.read_bytes()
    vla("quantize", SHIPPED, "-o", quantized).refused("usage", "--force")
    assert quantized.read_bytes() == before
    assert vla("quantize", SHIPPED, "-o", quantized, "--force", "--quiet").code == 0
    assert quantized.read_bytes() == before


def test_a_code_that_no_number_has_is_refused(vla, quantized, tmp_path):
    data = bytearray(quantized.read_bytes())
    data[data_offset(quantized, MATRIX) + 17] = 0x80
    (tmp_path / "code.gguf").write_bytes(sealed(data))
    answer = vla("inspect", tmp_path / "code.gguf")
    assert answer.code == 3 and f"wrong code      {MATRIX}" in answer.err and "-127 to 127, file has -128" in answer.err


@pytest.mark.parametrize("place, byte", [(0, 18), (1, 0x08), (32, 0x80)])
def test_a_block_of_int4_that_no_number_has_is_refused(vla, bundles, tmp_path, place, byte):
    data = bytearray((bundles / "int4.gguf").read_bytes())
    data[data_offset(bundles / "int4.gguf", MATRIX) + 33 * 5 + place] = byte
    (tmp_path / "block.gguf").write_bytes(sealed(data))
    answer = vla("inspect", tmp_path / "block.gguf")
    assert answer.code == 3 and f"wrong code      {MATRIX}" in answer.err and "steps of 0 to 17" in answer.err


def test_codes_without_their_scales_are_refused(vla, quantized, tmp_path):
    data = quantized.read_bytes().replace(MATRIX.encode() + b"_scale", MATRIX.encode() + b"_scalf", 1)
    (tmp_path / "lost.gguf").write_bytes(sealed(data))
    answer = vla("inspect", tmp_path / "lost.gguf")
    assert answer.code == 3 and "missing tensor" in answer.err and MATRIX + "_scale" in answer.err

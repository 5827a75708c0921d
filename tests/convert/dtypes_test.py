# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Exact conversions between number formats."""

import numpy as np
import pytest

from tiny import VLM, Tiny
from vla_cpp.convert.dtypes import bf16_to_f32, convert, f32_to_bf16
from vla_cpp.convert.errors import Code


def nearest_even_bf16(value):
    """The definition, in exact arithmetic: of the two neighbouring bfloat16 the nearer one, on a tie the one with an even last bit."""
    bits = int(np.float32(value).view(np.uint32))
    low, high = bits & 0xFFFF0000, (bits & 0xFFFF0000) + 0x10000

    def number(b):  # beyond the largest finite number the next step counts as if the exponent went on
        exponent, mantissa = (b >> 23) & 0xFF, b & 0x7FFFFF
        sign = -1 if b >> 31 else 1
        return sign * (mantissa * 2.0**-149 if exponent == 0 else (1 + mantissa / 2**23) * 2.0 ** (exponent - 127))

    down, up = abs(number(bits) - number(low)), abs(number(high) - number(bits))
    chosen = low if down < up or (down == up and not (low >> 16) & 1) else high
    return chosen >> 16


def test_bf16_rounding_is_to_nearest_with_ties_to_even_for_every_kind_of_number():
    rng = np.random.default_rng(0)
    bits = rng.integers(0, 1 << 32, 20000, dtype=np.uint32)
    ties = (rng.integers(0, 1 << 16, 5000, dtype=np.uint32) << 16) | 0x8000
    around = np.concatenate([ties - 1, ties + 1])
    edges = np.array(
        [
            0,
            1 << 31,
            1,
            0x8000,
            0x8001,
            0x17FFF,
            0x18000,
            0x7F7FFFFF,
            0xFF7FFFFF,
            0x7F7F7FFF,
            0x7F7F8000,
            0x007FFFFF,
            0x00800000,
        ],
        np.uint32,
    )
    values = np.concatenate([bits, ties, around, edges]).view(np.float32)
    values = values[np.isfinite(values)]
    expected = np.array([nearest_even_bf16(value) for value in values], np.uint16)
    np.testing.assert_array_equal(f32_to_bf16(values), expected)


def test_bf16_of_special_numbers():
    bits = np.array([0x7F800000, 0xFF800000, 0x7FC00000, 0x7F800001, 0xFFFFFFFF], np.uint32)
    got = f32_to_bf16(bits.view(np.float32))
    assert got[0] == 0x7F80 and got[1] == 0xFF80
    assert np.isnan(bf16_to_f32(got[2:])).all()  # a NaN whose payload lies in the lower half must not become infinity


def test_every_bf16_survives_the_way_through_f32():
    every = np.arange(1 << 16, dtype=np.uint32).astype(np.uint16)
    values = bf16_to_f32(every)
    numbers = ~np.isnan(values)
    np.testing.assert_array_equal(f32_to_bf16(values)[numbers], every[numbers])


@pytest.mark.parametrize(
    "dtype, target", [("F32", "f32"), ("F16", "f32"), ("BF16", "f32"), ("F16", "f16"), ("BF16", "bf16")]
)
def test_a_conversion_to_a_type_that_holds_everything_has_no_error(dtype, target):
    values = np.random.default_rng(1).standard_normal(1000).astype(np.float32)
    raw = {"F32": values, "F16": values.astype(np.float16), "BF16": f32_to_bf16(values)}[dtype]
    part = convert(raw, dtype, target)
    assert part.error == 0 and part.finite and not part.overflow
    np.testing.assert_array_equal(
        part.data if target != "f32" else part.data.astype(np.float64),
        raw if target != "f32" else (bf16_to_f32(raw) if dtype == "BF16" else raw).astype(np.float64),
    )


def test_the_largest_rounding_error_is_reported():
    part = convert(np.array([1.0, 1.0 + 2.0**-9, -3.0], np.float32), "F32", "bf16")
    assert part.error == 2.0**-9  # 1 + 2^-9 lies below the half step 2^-8 and becomes 1


@pytest.mark.parametrize("value, target", [(65520.0, "f16"), (-1e38, "f16"), (3.4e38, "bf16")])
def test_overflow_is_seen(value, target):
    assert convert(np.array([1, value], np.float32), "F32", target).overflow


@pytest.mark.parametrize("value, target", [(65519.0, "f16"), (3.38e38, "bf16")])
def test_the_largest_numbers_that_fit_are_no_overflow(value, target):
    assert not convert(np.array([value], np.float32), "F32", target).overflow


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_not_finite_are_seen(value):
    assert not convert(np.array([1, value], np.float32), "F32", "f16").finite


@pytest.mark.parametrize("dtype", ["bf16", "f16"])
def test_matrices_and_tables_take_the_dtype_and_vectors_and_statistics_stay_f32(converter, dtype):
    bundle = converter.bundle(Tiny(), dtype=dtype)
    for name, stored in bundle.dtypes.items():
        is_matrix = bundle.tensors[name].ndim == 2
        assert stored == (dtype if is_matrix else "f32"), name
    assert bundle.keys["vla.dtype"] == dtype and converter.summary.rounding[0] > 0


def as_bf16(value):
    return ("BF16", f32_to_bf16(value))


def test_one_stored_type_is_kept_and_mixed_types_become_exact_f32(converter):
    tiny = Tiny()
    values = {name: bf16_to_f32(f32_to_bf16(value)) for name, value in tiny.tensors.items()}
    tiny.tensors = {name: as_bf16(value) for name, value in values.items()}
    assert converter.bundle(tiny).keys["vla.dtype"] == "bf16"
    tiny.tensors["model.state_proj.weight"] = values["model.state_proj.weight"]
    bundle = converter.bundle(tiny)
    assert bundle.keys["vla.dtype"] == "f32" and any("mixed types" in note for note in converter.summary.notes)
    np.testing.assert_array_equal(
        bundle.tensors["lm.token_embd.weight"], values[VLM + "text_model.embed_tokens.weight"]
    )


def test_each_matrix_keeps_its_stored_type_on_request(converter):
    tiny = Tiny()
    tiny.tensors = {name: as_bf16(value) for name, value in tiny.tensors.items()}
    projection = np.random.default_rng(3).standard_normal(tiny.tensors["model.state_proj.weight"][1].shape, np.float32)
    tiny.tensors["model.state_proj.weight"] = projection
    bundle = converter.bundle(tiny, dtype="stored")
    assert bundle.keys["vla.dtype"] == "bf16" and converter.summary.rounding[0] == 0
    types = {name: stored for name, stored in bundle.dtypes.items() if bundle.tensors[name].ndim == 2}
    assert types.pop("state_in.weight") == "f32" and set(types.values()) == {"bf16"}
    np.testing.assert_array_equal(bundle.tensors["state_in.weight"], projection)


def test_more_than_one_narrow_type_is_not_kept(converter):
    tiny = Tiny()
    tiny.tensors = {name: as_bf16(value) for name, value in tiny.tensors.items()}
    tiny.tensors["model.state_proj.weight"] = bf16_to_f32(tiny.tensors["model.state_proj.weight"][1]).astype(np.float16)
    error = converter.refusal(tiny, dtype="stored")
    assert error.code == Code.UNSUPPORTED and "--dtype stored: expected float32 and one narrower type" in error.message()


def test_f32_and_bf16_files_of_the_same_numbers_give_the_same_bf16_bundle(converter):
    tiny = Tiny()
    tiny.tensors = {name: bf16_to_f32(f32_to_bf16(value)) for name, value in tiny.tensors.items()}
    converter.bundle(tiny, dtype="bf16")
    first = open(converter.out, "rb").read()
    tiny.tensors = {name: as_bf16(value) for name, value in tiny.tensors.items()}
    converter.bundle(tiny, dtype="bf16")
    assert open(converter.out, "rb").read() == first and converter.summary.rounding[0] == 0

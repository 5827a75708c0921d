# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Number formats of weights in safetensors files and in bundles, and conversions between them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

# Size in bytes of every element type that the safetensors format defines.
SIZES = {
    "BOOL": 1,
    "U8": 1,
    "I8": 1,
    "F8_E5M2": 1,
    "F8_E4M3": 1,
    "I16": 2,
    "U16": 2,
    "F16": 2,
    "BF16": 2,
    "I32": 4,
    "U32": 4,
    "F32": 4,
    "F64": 8,
    "I64": 8,
    "U64": 8,
}

# Element types that weights may have, with their numpy types; numpy has no bfloat16, so its bits are uint16.
WEIGHTS = {"F32": np.dtype("<f4"), "F16": np.dtype("<f2"), "BF16": np.dtype("<u2")}

# Statistics may also be doubles or integers; the reference loads all of them as float32.
STATISTICS = dict(WEIGHTS, F64=np.dtype("<f8"), I64=np.dtype("<i8"), I32=np.dtype("<i4"))

# A bundle's dtype names, with their numbers in ggml's enum ggml_type.
GGML_TYPES = {"f32": 0, "f16": 1, "i8": 24, "f64": 28, "bf16": 30}
BUNDLE_DTYPES = {"f32": np.dtype("<f4"), "f16": np.dtype("<f2"), "i8": np.dtype("i1"), "f64": np.dtype("<f8"), "bf16": np.dtype("<u2")}
BUNDLE_NAME = {"F32": "f32", "F16": "f16", "BF16": "bf16"}


class Converted(NamedTuple):
    """Converted numbers, and the effects of the conversion."""

    data: np.ndarray
    finite: bool  # every number was finite before the conversion
    overflow: bool  # a finite number became infinite
    error: float  # largest |stored - original|


def bf16_to_f32(bits: np.ndarray) -> np.ndarray:
    """Converts exactly: a bfloat16 is the upper half of a float32."""
    return (bits.astype(np.uint32) << 16).view(np.float32)


def f32_to_bf16(values: np.ndarray) -> np.ndarray:
    """Bits of the nearest bfloat16, ties to even. NaN stays NaN: rounding its bits like those of a number could carry them into infinity."""
    bits = np.ascontiguousarray(values, dtype=np.float32).view(np.uint32)
    rounded = (bits.astype(np.uint64) + 0x7FFF + ((bits >> 16) & 1)) >> 16
    return np.where(np.isnan(values), (bits >> 16) | 0x40, rounded).astype(np.uint16)


def to_f32(raw: np.ndarray, dtype: str) -> np.ndarray:
    """Stored numbers as float32: exact for F32, F16 and BF16; rounded to nearest for F64 and integers."""
    return bf16_to_f32(raw) if dtype == "BF16" else raw.astype(np.float32)


def from_f32(values: np.ndarray, target: str) -> np.ndarray:
    """float32 values in the bundle's type `target`, rounded to nearest, ties to even."""
    if target == "bf16":
        return f32_to_bf16(values)
    with np.errstate(over="ignore"):  # the caller detects overflow and reports it with the tensor's name
        return values.astype(BUNDLE_DTYPES[target])


def convert(raw: np.ndarray, dtype: str, target: str) -> Converted:
    """Converts numbers from the safetensors type `dtype` to the bundle's type `target`."""
    values = to_f32(raw, dtype)
    finite = bool(np.isfinite(values).all())
    stored = from_f32(values, target)
    if target == "f32" or not finite or raw.size == 0:
        return Converted(stored, finite, False, 0.0)
    back = to_f32(stored, target.upper())
    if not np.isfinite(back).all():
        return Converted(stored, finite, True, 0.0)
    return Converted(stored, finite, False, float(np.abs(back.astype(np.float64) - values).max()))

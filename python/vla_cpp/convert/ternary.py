# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Rounds matrices to -1, 0 and 1 during the conversion; the reference rounds the master weights in every forward pass.

Reference: BitVLA transformers modeling_bitnet.py and modeling_siglip.py (WeightQuant).
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from .dtypes import bf16_to_f32, f32_to_bf16, to_f32
from .safetensors_file import Entry

SMALLEST = np.float32(1e-5)  # lower limit of the mean, a literal of the reference


class Ternary(NamedTuple):
    codes: np.ndarray  # bytes of four numbers, each stored as number + 1 in two bits; number 4i is in bits 0 and 1
    scale: np.ndarray  # [1]: the factor of the matrix in a bfloat16 forward pass
    margin: float  # smallest distance of |number| * s from the rounding threshold 0.5


@lru_cache(maxsize=1)  # codes and scale of a matrix are requested one after the other
def quantize(entry: Entry) -> Ternary:
    """Rounds a matrix. The mean is computed in float64: the reference's float32 sum varies with the order by about 1e-7 relative."""
    values = np.concatenate([to_f32(part, entry.dtype) for part in entry.chunks()])
    with np.errstate(invalid="ignore", over="ignore"):  # numbers that are not finite make the scale not finite, which is reported
        mean = max(np.float32(np.abs(values).mean(dtype=np.float64)), SMALLEST)
        s = np.float32(1) / mean
        scaled = values * s
        codes = (np.clip(np.rint(scaled), -1, 1) + 1).astype(np.uint8)
        margin = float(np.abs(np.abs(scaled) - np.float32(0.5)).min())
    places = codes.reshape(-1, 4) << np.array([0, 2, 4, 6], np.uint8)
    scale = bf16_to_f32(f32_to_bf16(np.array([np.float32(1) / s], np.float32)))
    return Ternary(np.bitwise_or.reduce(places, axis=1).view(np.int8), scale, margin)

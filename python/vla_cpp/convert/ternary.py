# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Matrices of -1, 0 and 1: what the reference makes of a master weight in every forward pass, made once.

Reference: BitVLA transformers modeling_bitnet.py and modeling_siglip.py (WeightQuant).
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from .dtypes import bf16_to_f32, f32_to_bf16, to_f32
from .safetensors_file import Entry

SMALLEST = np.float32(1e-5)  # of a mean, a literal of the reference


class Ternary(NamedTuple):
    codes: np.ndarray  # bytes: number 4i in bits 0 and 1 as number + 1
    scale: np.ndarray  # [1]: what 1 stands for in a forward pass of bfloat16
    margin: float  # smallest distance of |number| * s from 0.5, where the code changes


@lru_cache(maxsize=1)  # codes and scale are written one after the other
def quantize(entry: Entry) -> Ternary:
    """The mean is made in float64: the reference's float32 sum depends on its order by parts in 1e7."""
    values = np.concatenate([to_f32(part, entry.dtype) for part in entry.chunks()])
    with np.errstate(invalid="ignore", over="ignore"):  # what is not finite is told by the scale
        mean = max(np.float32(np.abs(values).mean(dtype=np.float64)), SMALLEST)
        s = np.float32(1) / mean
        scaled = values * s
        codes = (np.clip(np.rint(scaled), -1, 1) + 1).astype(np.uint8)
        margin = float(np.abs(np.abs(scaled) - np.float32(0.5)).min())
    places = codes.reshape(-1, 4) << np.array([0, 2, 4, 6], np.uint8)
    scale = bf16_to_f32(f32_to_bf16(np.array([np.float32(1) / s], np.float32)))
    return Ternary(np.bitwise_or.reduce(places, axis=1).view(np.int8), scale, margin)

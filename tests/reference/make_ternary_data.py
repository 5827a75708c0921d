# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Writes tests/kernels/data/ternary.npy: a ternary product with int8 activations as BitVLA's BitLinear defines it.

    python tests/reference/make_ternary_data.py tests/kernels/data/ternary.npy

The two quantizers of modeling_bitnet.py (WeightQuant, ActQuant) taken apart, an operation at a time in float32; torch
computes `127 / a` as the reciprocal times 127.  One row of float32 numbers: x (7, 272), ternary codes of W (17, 272),
scale of W, bias (17), codes of x (7, 272), their scales (7), sums (7, 17), y (7, 17).
"""

import sys

import numpy as np

N_ROW, D_IN, D_OUT = 7, 272, 17


def to_bf16(x: np.ndarray) -> np.ndarray:
    """To the nearest bfloat16, ties to even, as float32."""
    bits = x.astype(np.float32).view(np.uint32)
    return ((bits + 0x7FFF + (bits >> 16 & 1)) & 0xFFFF0000).astype(np.uint32).view(np.float32)


def quantize_weight(w: np.ndarray) -> tuple[np.ndarray, np.float32]:
    """Codes, and the magnitude that bfloat16 inference multiplies by."""
    scale = np.float32(1) / max(np.float32(np.abs(w).mean(dtype=np.float64)), np.float32(1e-5))
    return np.clip(np.rint(w * scale), -1, 1), to_bf16(np.array([np.float32(1) / scale]))[0]


def quantize_rows(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    largest = np.maximum(np.abs(x).max(axis=1), np.float32(1e-5))
    scale = (np.float32(1) / largest) * np.float32(127)
    return np.clip(np.rint(x * scale[:, None]), -128, 127), scale


def main() -> None:
    random = np.random.default_rng(7)
    x = random.normal(size=(N_ROW, D_IN)).astype(np.float32)
    x[1] = 0  # the smallest scale
    x[2] *= np.float32(1e-6)  # below it
    x[3] = np.float32(0.5) * random.integers(-126, 127, D_IN)  # halves between codes
    x[3, 5] = 127
    x[4, 7] = 1000  # one large number
    x[5] = to_bf16(x[5])
    weight, step = quantize_weight(to_bf16(random.normal(size=(D_OUT, D_IN)) * 0.05))
    bias = random.normal(size=D_OUT).astype(np.float32)
    codes, scale = quantize_rows(x)
    sums = codes.astype(np.int64) @ weight.astype(np.int64).T
    y = sums.astype(np.float32) * (step / scale)[:, None] + bias
    assert y.dtype == scale.dtype == np.float32
    parts = [x, weight, np.array([step]), bias, codes, scale, sums, y]
    np.save(sys.argv[1], np.concatenate([part.astype(np.float32).ravel() for part in parts])[None])


main()

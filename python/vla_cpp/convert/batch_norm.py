# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Folds a convolution and the frozen batch norm after it into one convolution with a bias.

    norm(W x) = (W x - mean) * scale + bias = (scale W) x + (bias - mean * scale),   scale = weight / sqrt(variance + eps)

Computed in float64 and rounded once. The reference rounds after each of these steps; the difference from it is less than its own rounding
error. Reference: torchvision ops/misc.py FrozenBatchNorm2d.
"""

from __future__ import annotations

from typing import Dict, Mapping, Tuple

import numpy as np

from .dtypes import to_f32
from .safetensors_file import Entry

EPS = 1e-5  # eps of FrozenBatchNorm2d
PARTS = ("weight", "bias", "running_mean", "running_var")


def shapes(name: str, d: int) -> Dict[str, Tuple[int, ...]]:
    """The tensors of a batch norm of d features."""
    return {"{}.{}".format(name, part): (d,) for part in PARTS}


def folded(entry: Entry, name: str, tensors: Mapping[str, Entry]) -> np.ndarray:
    """The folded tensor in float32. For the convolution's weight (out, in, row, column): the matrix (out, row x column x in), flat. For the
    norm's bias (out,): the folded bias."""
    weight, bias, mean, variance = (whole(tensors["{}.{}".format(name, part)]) for part in PARTS)
    with np.errstate(all="ignore"):  # numbers that are not finite are reported with the tensor
        scale = weight / np.sqrt(variance + EPS)
        if len(entry.shape) == 1:
            return (bias - mean * scale).astype(np.float32)
        product = whole(entry) * scale[:, None, None, None]
        return product.transpose(0, 2, 3, 1).astype(np.float32).ravel()


def whole(entry: Entry) -> np.ndarray:
    return np.concatenate([to_f32(part, entry.dtype) for part in entry.chunks()]).reshape(entry.shape).astype(np.float64)

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Convolutions of standardized pixels as convolutions of pixels from 0 to 1.

    W (x - mean) / std + bias = (W / std) x + (bias - sum(W mean / std))

Computed in float64 and rounded once, so that it differs from the reference, which rounds the standardized pixels first, by less than the
reference's own rounding.
"""

from __future__ import annotations

from typing import Mapping, NamedTuple, Tuple

import numpy as np

from .batch_norm import whole
from .safetensors_file import Entry


class Standardized(NamedTuple):
    """What a convolution reads: by channel what is subtracted from pixels, and what they are divided by. `source`: of its weight."""

    source: str
    mean: Tuple[float, ...]
    std: Tuple[float, ...]


def folded(entry: Entry, pixels: Standardized, tensors: Mapping[str, Entry]) -> np.ndarray:
    """Of the convolution's weight (out, in, row, column) the matrix in float32, of its bias the bias."""
    mean, std = (np.asarray(values, np.float64)[:, None, None] for values in (pixels.mean, pixels.std))
    weight = whole(tensors[pixels.source]) / std
    with np.errstate(all="ignore"):  # what is not finite is reported with the tensor
        if len(entry.shape) == 1:
            return (whole(entry) - (weight * mean).sum((1, 2, 3))).astype(np.float32)
        return weight.astype(np.float32).ravel()

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Folds the standardization of pixels into a convolution, which then reads pixels from 0 to 1.

    W (x - mean) / std + bias = (W / std) x + (bias - sum(W mean / std))

Computed in float64 and rounded once. The reference rounds the standardized pixels first; the difference from it is less than its own
rounding error.
"""

from __future__ import annotations

from typing import Mapping, NamedTuple, Tuple

import numpy as np

from .batch_norm import whole
from .safetensors_file import Entry


class Standardized(NamedTuple):
    """The standardization of a convolution's input: (pixel - mean) / std per channel. source: name of the convolution's weight."""

    source: str
    mean: Tuple[float, ...]
    std: Tuple[float, ...]


def folded(entry: Entry, pixels: Standardized, tensors: Mapping[str, Entry]) -> np.ndarray:
    """The folded tensor in float32: for the convolution's weight (out, in, row, column) the flat matrix, for its bias the bias."""
    mean, std = (np.asarray(values, np.float64)[:, None, None] for values in (pixels.mean, pixels.std))
    weight = whole(tensors[pixels.source]) / std
    with np.errstate(all="ignore"):  # numbers that are not finite are reported with the tensor
        if len(entry.shape) == 1:
            return (whole(entry) - (weight * mean).sum((1, 2, 3))).astype(np.float32)
        return weight.astype(np.float32).ravel()

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Normalization of pixels, by statistics of the policy's cameras or by those of ImageNet."""

from __future__ import annotations

from typing import List, Sequence, Tuple

import numpy as np

from .errors import Problems
from .normalization import Normalization

MIN_SPREAD = 1e-6  # smallest divisor in the recipe
IMAGENET = {"mean": [0.485, 0.456, 0.406], "std": [0.229, 0.224, 0.225]}


def standardized(views: Sequence[Tuple[str, Normalization]], problems: Problems) -> List[dict]:
    """Recipe ops that normalize pixels in [0, 1]; views with the same statistics share one op. Min/max ranges are mapped to [-1, 1].
    Reference: lerobot processor/normalize_processor.py, in float32."""
    ops, seen = [], []
    for i, (name, norm) in enumerate(views):
        if norm.kind == "identity":
            continue
        low, spread = offset_and_spread(norm)
        if not (spread >= MIN_SPREAD).all():
            problems.unsupported("statistics of " + name, "pixels that differ by {:g} or more".format(MIN_SPREAD), str(spread.min()))
        ops.append({"op": "standardize", "mean": numbers(low), "std": numbers(spread), "arithmetic": "float32", "view": i})
        seen.append({key: value for key, value in ops[-1].items() if key != "view"})
    if len(ops) == len(views) and all(op == seen[0] for op in seen):
        ops = seen[:1]
    ranges = [norm.kind not in ("identity", "mean_std") for _, norm in views]
    return ops + ([{"op": "affine", "scale": 2.0, "shift": -1.0}] if any(ranges) else [])


def offset_and_spread(norm: Normalization) -> Tuple[np.ndarray, np.ndarray]:
    """The number to subtract and the divisor, per channel."""
    first, second = (value.astype(np.float32).ravel() for value in norm.statistics.values())
    if norm.kind == "mean_std":
        return first, second + np.float32(norm.eps)
    spread = second - first
    return first, np.where(spread == 0, np.float32(norm.eps), spread)


def numbers(values: np.ndarray) -> List[float]:
    return [float(value) for value in values]

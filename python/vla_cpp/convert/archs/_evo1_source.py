# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What the two layouts of Evo-1 have to say, in one form."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Dict, List

import numpy as np

from ..bundle import Key
from ._evo1_names import Names
from ._evo1_sizes import Sizes

# ImageNet's, literals of both references.
MEAN, STD = [0.485, 0.456, 0.406], [0.229, 0.224, 0.225]


@dataclass
class Source:
    sizes: Sizes
    names: Names
    tokenizer: str  # its folder
    image_token: object  # the id that the backbone's config states, None where it states none
    image: List[dict]
    state: List[dict]
    action: List[dict]
    features: List[Key]
    statistics: Dict[str, np.ndarray]


def image_ops(side: int, filter_name: str, arithmetic: str) -> List[dict]:
    return [
        {"op": "resize", "width": side, "height": side, "filter": filter_name},
        {"op": "standardize", "mean": MEAN, "std": STD, "arithmetic": arithmetic},
    ]


def pad_op(size: int, value: float) -> dict:
    return {"op": "pad", "size": size, **({"value": value} if value else {})}

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What a family of π states about itself, and what each layout of its checkpoints has to find out."""

from __future__ import annotations

from typing import Dict, List, NamedTuple

import numpy as np

from .. import recipe
from ..bundle import Key
from ._pi_sizes import Sizes


class Family(NamedTuple):
    """In what the two differ."""

    arch: str
    config_class: str
    max_tokens: int  # what openpi's configurations allow; LeRobot's pipelines state it
    time_mlp: str  # the tensors of the time layers
    other_time_mlp: str  # what the other family calls them

    @property
    def state_token(self) -> bool:
        """π0 has the state as a token; π0.5 has it in the prompt and time in its norms."""
        return self.arch == "pi0"


class Source(NamedTuple):
    """What the layout of the checkpoint contributes: sizes, recipe, features, statistics."""

    sizes: Sizes
    processors: recipe.Processors  # empty for openpi, which has none
    image: List[dict]
    text: List[dict]  # without the last op
    state: List[dict]
    action: List[dict]
    features: List[Key]
    statistics: Dict[str, np.ndarray]
    max_tokens: int

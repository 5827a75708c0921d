# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Widths and counts of GR00T, from the configs of the policy and of its backbone."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Dict, List, Optional

from ...networks import Language, Vision, pick

WHERE = "backbone config.json"


@dataclass
class Sizes:
    """Widths and counts; the names are those of the bundle's keys."""

    vision: Vision = field(default_factory=Vision)
    image_width: int = 0
    image_height: int = 0
    n_position_side: int = 0
    merge: int = 2  # patches per side of the square that becomes one token
    deepstack_layers: List[int] = field(default_factory=list)
    lm: Language = field(default_factory=Language)
    n_context: int = 0
    rope_sections: List[int] = field(default_factory=list)
    n_vl_layer: int = 0
    n_vl_head: int = 1
    d_dit: int = 0
    n_dit_layer: int = 0
    n_dit_head: int = 0
    d_out: int = 0
    attend_text_every_n_blocks: int = 0
    n_bucket: int = 0
    d_hidden: int = 0
    d_state: int = 0  # numbers in a state token: all moments of state_history_length
    state_history: int = 1
    n_state_row: int = 1  # tokens of the state, if each moment is a token
    d_action: int = 0
    horizon: int = 0
    n_position: int = 0
    n_step: int = 0
    rtc_ramp_rate: Optional[float] = None  # None: the release has no real-time chunking
    n_embodiment: int = 0
    embodiment: int = 0  # the robot's index, below n_embodiment
    max_views: int = 0
    d_time: int = 256  # a literal of the reference, like the factor 4 of the feed-forward layers

    @property
    def d_vl_ff(self) -> int:
        return 4 * self.lm.d_model

    @property
    def d_dit_ff(self) -> int:
        return 4 * self.d_dit

    def vision_keys(self) -> Dict[str, object]:
        """Key values that the towers of all releases have."""
        return pick(self.vision, "d_model n_layer n_head d_ff patch_size")

    @property
    def n_view_token(self) -> int:
        side = self.merge * self.vision.patch_size
        return self.image_width // side * (self.image_height // side)

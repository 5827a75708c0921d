# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Keys of the network and names of every tensor of SmolVLA."""

from __future__ import annotations

import math
from typing import Dict, List

from ...bundle import Key
from ...layers import Rows, linear
from ...networks import decoder, dropped_of_last, expert, keys_of, pick, siglip
from .. import Dropped
from .config import Sizes

VLM = "model.vlm_with_expert.vlm.model."
TEXT, EXPERT = VLM + "text_model.", "model.vlm_with_expert.lm_expert."


def network_keys(s: Sizes) -> List[Key]:
    scale = math.sqrt(s.lm.d_model)
    return keys_of(
        {
            "policy": dict(pick(s, "d_state d_action horizon"), image_scale=scale, text_scale=scale),
            "vision": {**vars(s.vision), "position_rule": "bucketize_" + s.position_precision},
            "connector": dict(factor=s.factor),
            "lm": s.lm,
            "expert": dict(
                d_model=s.d_expert,
                n_layer=s.n_expert_layer,
                d_ff=s.d_expert_ff,
                **pick(s.lm, "norm_eps rope_base"),
                layer_kinds=s.layer_kinds,
            ),
            "time": pick(s, "min_period max_period"),
            "solver": dict(steps=s.n_step, t_start=1.0, t_end=0.0, kind="euler", noise="normal"),
        }
    )


def weights(s: Sizes) -> Rows:
    d = s.d_expert
    return [
        *siglip(VLM + "vision_model.", s.vision),
        *linear("connector", VLM + "connector.modality_projection.proj", s.lm.d_model, s.vision.d_model * s.factor**2, bias=False),
        *decoder(s.lm, TEXT, end="cache"),
        *linear("state_in", "model.state_proj", s.lm.d_model, s.d_state),
        *linear("action_in", "model.action_in_proj", d, s.d_action),
        *linear("action_time_in", "model.action_time_mlp_in", d, 2 * d),
        *linear("action_time_out", "model.action_time_mlp_out", d, d),
        *expert(EXPERT, d, s.d_expert_ff, s.lm, d_in=s.d_kv_in),
        *linear("action_out", "model.action_out_proj", s.d_action, d),
    ]


def dropped(s: Sizes) -> List[Dropped]:
    head = "model.vlm_with_expert.vlm.lm_head.weight"
    return [Dropped(head, (s.lm.n_vocab, s.lm.d_model), "no action depends on the language head"), *dropped_of_last(s.lm, TEXT)]


def hints(s: Sizes) -> Dict[str, str]:
    return {
        TEXT + "layers.": "num_vlm_layers is {}: text layers are 0 to {}".format(s.lm.n_layer, s.lm.n_layer - 1),
        EXPERT + "layers.": "the expert's layers are 0 to {}".format(s.n_expert_layer - 1),
    }

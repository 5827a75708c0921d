# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Keys of the network and names, storage and shapes of every tensor of SmolVLA."""

from __future__ import annotations

import math
from typing import Dict, List

from ...bundle import Key
from ...layers import gated_block, linear, siglip, vector
from ...networks import dropped_of_last, embedding, keys_and_values, keys_of
from .. import Dropped, Weight
from .config import Sizes

VLM = "model.vlm_with_expert.vlm.model."
TEXT = VLM + "text_model."
EXPERT = "model.vlm_with_expert.lm_expert."


def network_keys(s: Sizes) -> List[Key]:
    scale = math.sqrt(s.lm.d_model)
    policy = dict(d_state=s.d_state, d_action=s.d_action, horizon=s.horizon, image_scale=scale, text_scale=scale)
    expert = dict(d_model=s.d_expert, n_layer=s.n_expert_layer, d_ff=s.d_expert_ff)
    keys = keys_of(
        {
            "policy": policy,
            "vision": {**vars(s.vision), "position_rule": "bucketize_" + s.position_precision},
            "connector": dict(factor=s.factor),
            "lm": s.lm,
            "expert": dict(expert, norm_eps=s.lm.norm_eps, rope_base=s.lm.rope_base),
            "time": dict(min_period=s.min_period, max_period=s.max_period),
            "solver": dict(steps=s.n_step, t_start=1.0, t_end=0.0, kind="euler", noise="normal"),
        }
    )
    return [*keys, Key("expert.layer_kinds", "string[]", s.layer_kinds)]


def weights(s: Sizes) -> List[Weight]:
    v = s.vision
    return [
        *siglip(VLM + "vision_model.", v.d_model, v.d_ff, v.n_layer, v.patch_size, v.n_patch),
        *linear("connector", VLM + "connector.modality_projection.proj", s.lm.d_model, v.d_model * s.factor**2),
        embedding(s.lm, TEXT + "embed_tokens.weight"),
        *keys_and_values(s.lm, TEXT),
        *_projections(s),
        *_expert(s),
    ]


def _projections(s: Sizes) -> List[Weight]:
    d = s.d_expert
    return [
        *linear("state_in", "model.state_proj", s.lm.d_model, s.d_state, bias=True),
        *linear("action_in", "model.action_in_proj", d, s.d_action, bias=True),
        *linear("action_time_in", "model.action_time_mlp_in", d, 2 * d, bias=True),
        *linear("action_time_out", "model.action_time_mlp_out", d, d, bias=True),
    ]


def _expert(s: Sizes) -> List[Weight]:
    rows: List[Weight] = []
    for j in range(s.n_expert_layer):
        target, source = "expert.blk.{}.".format(j), "{}layers.{}.".format(EXPERT, j)
        block = gated_block(target, source, s.d_expert, s.lm.d_q, s.lm.d_kv, s.d_kv_in[j], s.d_expert_ff)
        rows += [weight for weights in block.values() for weight in weights]
    rows += vector("expert.norm.weight", EXPERT + "norm.weight", s.d_expert)
    return rows + linear("action_out", "model.action_out_proj", s.d_action, s.d_expert, bias=True)


def dropped(s: Sizes) -> List[Dropped]:
    head = "model.vlm_with_expert.vlm.lm_head.weight"
    return [Dropped(head, (s.lm.n_vocab, s.lm.d_model), "no action depends on the language head"), *dropped_of_last(s.lm, TEXT)]


def hints(s: Sizes) -> Dict[str, str]:
    return {
        TEXT + "layers.": "num_vlm_layers is {}: text layers are 0 to {}".format(s.lm.n_layer, s.lm.n_layer - 1),
        EXPERT + "layers.": "the expert's layers are 0 to {}".format(s.n_expert_layer - 1),
    }

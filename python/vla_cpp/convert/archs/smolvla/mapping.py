# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Keys of the network and names, storage and shapes of every tensor of SmolVLA."""

from __future__ import annotations

import math
from typing import Dict, List

from ...bundle import Key, keys_by_type
from ...layers import KEPT_OF_LAST, gated_block, linear, siglip, vector
from .. import TABLE, Dropped, Weight
from .config import Sizes

VLM = "model.vlm_with_expert.vlm.model."
EXPERT = "model.vlm_with_expert.lm_expert."


def network_keys(s: Sizes) -> List[Key]:
    """RoPE has base 10000 whatever the backbone's config says: the reference rotates with a function of its own
    (smolvlm_with_expert.py: apply_rope) and reads neither rope_theta nor rope_scaling."""
    u32 = {
        "policy.d_state": s.d_state,
        "policy.d_action": s.d_action,
        "policy.horizon": s.horizon,
        "vision.d_model": s.d_vision,
        "vision.n_layer": s.n_vision_layer,
        "vision.n_head": s.n_vision_head,
        "vision.d_ff": s.d_vision_ff,
        "vision.image_size": s.image_size,
        "vision.patch_size": s.patch_size,
        "connector.factor": s.factor,
        "lm.d_model": s.d_model,
        "lm.n_layer": s.n_layer,
        "lm.n_head": s.n_head,
        "lm.n_head_kv": s.n_head_kv,
        "lm.d_head": s.d_head,
        "lm.d_ff": s.d_ff,
        "lm.n_vocab": s.n_vocab,
        "expert.d_model": s.d_expert,
        "expert.n_layer": s.n_expert_layer,
        "expert.d_ff": s.d_expert_ff,
        "solver.steps": s.n_step,
    }
    scale = math.sqrt(s.d_model)
    f32 = {
        "policy.image_scale": scale,
        "policy.text_scale": scale,
        "vision.norm_eps": s.vision_eps,
        "lm.norm_eps": s.lm_eps,
        "lm.rope_base": 10000.0,
        "expert.norm_eps": s.lm_eps,
        "expert.rope_base": 10000.0,
    }
    f64 = {"time.min_period": s.min_period, "time.max_period": s.max_period, "solver.t_start": 1.0, "solver.t_end": 0.0}
    text = {
        "vision.position_rule": "bucketize_" + s.position_precision,
        "solver.kind": "euler",
        "solver.noise": "normal",
    }
    keys = keys_by_type({"u32": u32, "f32": f32, "f64": f64, "string": text})
    return keys + [Key("expert.layer_kinds", "string[]", s.layer_kinds)]


def weights(s: Sizes) -> List[Weight]:
    n_position = (s.image_size // s.patch_size) ** 2
    return [
        *siglip(VLM + "vision_model.", s.d_vision, s.d_vision_ff, s.n_vision_layer, s.patch_size, n_position),
        *linear("connector", VLM + "connector.modality_projection.proj", s.d_model, s.d_vision * s.factor**2),
        *_language(s),
        *_projections(s),
        *_expert(s),
    ]


def _language_block(s: Sizes, i: int) -> Dict[str, List[Weight]]:
    d_kv = s.n_head_kv * s.d_head
    return gated_block(
        "lm.blk.{}.".format(i),
        "{}text_model.layers.{}.".format(VLM, i),
        s.d_model,
        s.n_head * s.d_head,
        d_kv,
        s.d_model,
        s.d_ff,
    )


def _language(s: Sizes) -> List[Weight]:
    source = VLM + "text_model.embed_tokens.weight"
    rows = [Weight("lm.token_embd.weight", source, TABLE, (s.n_vocab, s.d_model), (s.n_vocab, s.d_model))]
    for i in range(s.n_layer):
        for part, weights in _language_block(s, i).items():
            if i < s.n_layer - 1 or part in KEPT_OF_LAST:
                rows += weights
    return rows


def _projections(s: Sizes) -> List[Weight]:
    d = s.d_expert
    return [
        *linear("state_in", "model.state_proj", s.d_model, s.d_state, bias=True),
        *linear("action_in", "model.action_in_proj", d, s.d_action, bias=True),
        *linear("action_time_in", "model.action_time_mlp_in", d, 2 * d, bias=True),
        *linear("action_time_out", "model.action_time_mlp_out", d, d, bias=True),
    ]


def _expert(s: Sizes) -> List[Weight]:
    d_kv = s.n_head_kv * s.d_head
    rows: List[Weight] = []
    for j in range(s.n_expert_layer):
        block = gated_block(
            "expert.blk.{}.".format(j),
            "{}layers.{}.".format(EXPERT, j),
            s.d_expert,
            s.n_head * s.d_head,
            d_kv,
            s.d_kv_in[j],
            s.d_expert_ff,
        )
        rows += [weight for weights in block.values() for weight in weights]
    rows += vector("expert.norm.weight", EXPERT + "norm.weight", s.d_expert)
    return rows + linear("action_out", "model.action_out_proj", s.d_action, s.d_expert, bias=True)


def dropped(s: Sizes) -> List[Dropped]:
    last = [
        weight
        for part, weights in _language_block(s, s.n_layer - 1).items()
        if part not in KEPT_OF_LAST
        for weight in weights
    ]
    return [
        Dropped(
            "model.vlm_with_expert.vlm.lm_head.weight", (s.n_vocab, s.d_model), "no action depends on the language head"
        ),
        Dropped(VLM + "text_model.norm.weight", (s.d_model,), "the prefix leaves only keys and values"),
        *(
            Dropped(weight.source, weight.stored, "the last language layer leaves only keys and values")
            for weight in last
        ),
    ]


def hints(s: Sizes) -> Dict[str, str]:
    return {
        VLM + "text_model.layers.": "num_vlm_layers is {}: text layers are 0 to {}".format(s.n_layer, s.n_layer - 1),
        EXPERT + "layers.": "the expert's layers are 0 to {}".format(s.n_expert_layer - 1),
    }

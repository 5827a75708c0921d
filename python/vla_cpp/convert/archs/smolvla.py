# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""SmolVLA: what its checkpoint states, as keys and tensors of a bundle.

Reference: lerobot src/lerobot/policies/smolvla (configuration_smolvla.py, smolvlm_with_expert.py, modeling_smolvla.py) and
transformers models/smolvlm. Shapes come from the configs alone; a tensor of another shape is refused, not adopted.
"""

from __future__ import annotations

import json
import math
from typing import Dict, List

from .. import recipe
from ..bundle import Key, keys_by_type
from ..checkpoint import Checkpoint
from ..errors import Problems
from ..features import feature_keys
from ..tokenizer import read_tokenizer
from . import TABLE, Dropped, Options, Plan, Weight
from ._lerobot import tokenizer_folder, view_keys
from ._rows import KEPT_OF_LAST, gated_block, linear, siglip, vector
from ._smolvla_sizes import Sizes, read_sizes

VLM = "model.vlm_with_expert.vlm.model."
EXPERT = "model.vlm_with_expert.lm_expert."
STEPS: recipe.Steps = {recipe.PRE: {"smolvla_new_line_processor": {}}}


def plan(checkpoint: Checkpoint, options: Options, problems: Problems) -> Plan:
    sizes = read_sizes(checkpoint, options, problems)
    problems.raise_any()
    dims = {recipe.STATE: sizes.state_dim, recipe.ACTION: sizes.action_dim}
    processors = recipe.read_processors(checkpoint, dims, options.identity_stats, problems, STEPS)
    folder = tokenizer_folder(checkpoint, options, processors) or sizes.backbone
    tokenizer = read_tokenizer(folder, sizes.n_vocab, problems, checkpoint.notes)
    document = json.dumps(_recipe(sizes, processors, tokenizer.truncate), ensure_ascii=False)
    keys = [
        *_network_keys(sizes),
        *_feature_keys(checkpoint, options, sizes, processors, problems),
        *tokenizer.keys,
        Key("processor.recipe", "string", document),
    ]
    problems.raise_any()
    return Plan(keys, _weights(sizes), _dropped(sizes), processors.statistics(), _hints(sizes))


def _hints(s: Sizes) -> Dict[str, str]:
    return {
        VLM + "text_model.layers.": "num_vlm_layers is {}: text layers are 0 to {}".format(s.n_layer, s.n_layer - 1),
        EXPERT + "layers.": "the expert's layers are 0 to {}".format(s.n_expert_layer - 1),
    }


def _recipe(s: Sizes, processors: recipe.Processors, truncate: str) -> Dict[str, List[dict]]:
    return {
        "image": [recipe.letterbox(*s.frame, "bottom_right"), {"op": "affine", "scale": 2.0, "shift": -1.0}],
        "text": recipe.text_ops(processors, truncate),
        "state": [*processors.state.op("normalize", recipe.STATE), {"op": "pad", "size": s.d_state}],
        "action": [{"op": "take", "size": s.action_dim}, *processors.action.op("unnormalize", recipe.ACTION)],
    }


def _feature_keys(
    checkpoint: Checkpoint, options: Options, s: Sizes, processors: recipe.Processors, problems: Problems
) -> List[Key]:
    """One view is enough: the reference (prepare_images) drops every view that is missing, or masks it, which is the same."""
    return [
        *view_keys(checkpoint, s.views, processors, problems),
        Key("observation.states", "string[]", [recipe.STATE]),
        Key("observation.state_dims", "u32[]", [s.state_dim]),
        Key("observation.max_text_tokens", "u32", processors.max_tokens),
        *feature_keys(
            options.dataset_info, {recipe.STATE: s.state_dim, recipe.ACTION: s.action_dim}, checkpoint.notes, problems
        ),
    ]


def _network_keys(s: Sizes) -> List[Key]:
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


def _weights(s: Sizes) -> List[Weight]:
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


def _dropped(s: Sizes) -> List[Dropped]:
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

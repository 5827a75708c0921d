# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""SmolVLA: what its checkpoint states, as keys and tensors of a bundle.

Reference: lerobot src/lerobot/policies/smolvla (configuration_smolvla.py, smolvlm_with_expert.py, modeling_smolvla.py) and
transformers models/smolvlm. Shapes come from the configs alone; a tensor of another shape is refused, not adopted.
"""

from __future__ import annotations

import json
import math
import os
from typing import Dict, List

from .. import recipe
from ..bundle import Key
from ..checkpoint import Checkpoint
from ..errors import Problems
from ..features import feature_keys
from ..tokenizer import read_tokenizer
from . import MATRIX, TABLE, VECTOR, Dropped, Options, Plan, Weight
from ._smolvla_sizes import Sizes, read_sizes

VLM = "model.vlm_with_expert.vlm.model."
EXPERT = "model.vlm_with_expert.lm_expert."
EMPTY_CAMERA = "observation.images.empty_camera_"


def plan(checkpoint: Checkpoint, options: Options, problems: Problems) -> Plan:
    sizes = read_sizes(checkpoint, options, problems)
    problems.raise_any()
    dims = {recipe.STATE: sizes.state_dim, recipe.ACTION: sizes.action_dim}
    processors = recipe.read_processors(checkpoint, dims, options.identity_stats, problems)
    tokenizer_folder = _tokenizer_folder(checkpoint, options, sizes, processors)
    tokenizer = read_tokenizer(tokenizer_folder, sizes.n_vocab, problems, checkpoint.notes)
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


def _tokenizer_folder(checkpoint: Checkpoint, options: Options, sizes: Sizes, processors: recipe.Processors) -> str:
    """The tokenizer that the reference would load: the checkpoint's own where its processor declares one, else the backbone's."""
    own = processors.own_tokenizer or ("" if options.backbone else "tokenizer")
    if not own or not (processors.own_tokenizer or os.path.exists(checkpoint.path(own))):
        return sizes.backbone
    checkpoint.notes.append("tokenizer: from {}/ inside the checkpoint".format(own))
    return checkpoint.path(own)


def _recipe(s: Sizes, processors: recipe.Processors, truncate: str) -> Dict[str, List[dict]]:
    width, height = s.frame
    letterbox = {
        "op": "letterbox",
        "width": width,
        "height": height,
        "filter": "bilinear",
        "antialias": False,
        "align": "bottom_right",
        "fill": 0.0,
    }
    return {
        "image": [letterbox, {"op": "affine", "scale": 2.0, "shift": -1.0}],
        "text": recipe.text_ops(processors, truncate),
        "state": [*processors.state.op("normalize", recipe.STATE), {"op": "pad", "size": s.d_state}],
        "action": [{"op": "take", "size": s.action_dim}, *processors.action.op("unnormalize", recipe.ACTION)],
    }


def _feature_keys(
    checkpoint: Checkpoint, options: Options, s: Sizes, processors: recipe.Processors, problems: Problems
) -> List[Key]:
    """One view is enough: the reference (prepare_images) drops every view that is missing, or masks it, which is the same.

    The cameras that `empty_cameras` adds to the features stand in no data set, so nobody need declare them absent.
    """
    empty = [view for view in s.views if view.startswith(EMPTY_CAMERA)]
    if empty:
        checkpoint.notes.append("views that stay empty unless a frame is given: " + ", ".join(empty))
    return [
        Key("observation.views", "string[]", s.views),
        Key(
            "observation.view_aliases", "string[]", recipe.view_aliases(s.views, processors, checkpoint.notes, problems)
        ),
        Key("observation.view_optional", "u32[]", [int(view in empty) for view in s.views]),
        Key("observation.min_views", "u32", 1),
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
    keys = [
        Key(name, kind, value)
        for kind, group in (("u32", u32), ("f32", f32), ("f64", f64), ("string", text))
        for name, value in group.items()
    ]
    return keys + [Key("expert.layer_kinds", "string[]", s.layer_kinds)]


def _linear(target: str, source: str, d_out: int, d_in: int, bias: bool = False) -> List[Weight]:
    rows = [Weight(target + ".weight", source + ".weight", MATRIX, (d_out, d_in), (d_out, d_in))]
    return rows + (_vector(target + ".bias", source + ".bias", d_out) if bias else [])


def _vector(target: str, source: str, size: int) -> List[Weight]:
    return [Weight(target, source, VECTOR, (size,), (size,))]


def _norm(target: str, source: str, size: int) -> List[Weight]:
    return _vector(target + ".weight", source + ".weight", size) + _vector(target + ".bias", source + ".bias", size)


def _weights(s: Sizes) -> List[Weight]:
    return _vision(s) + _language(s) + _projections(s) + _expert(s)


def _vision(s: Sizes) -> List[Weight]:
    source, d = VLM + "vision_model.", s.d_vision
    pixels = 3 * s.patch_size**2
    n_position = (s.image_size // s.patch_size) ** 2
    rows = [
        # A convolution whose stride is its kernel is a matrix over the flattened patch: channel, row, column.
        Weight(
            "vision.patch_embed.weight",
            source + "embeddings.patch_embedding.weight",
            MATRIX,
            (d, 3, s.patch_size, s.patch_size),
            (d, pixels),
        ),
        *_vector("vision.patch_embed.bias", source + "embeddings.patch_embedding.bias", d),
        Weight(
            "vision.position.weight",
            source + "embeddings.position_embedding.weight",
            TABLE,
            (n_position, d),
            (n_position, d),
        ),
    ]
    for i in range(s.n_vision_layer):
        target, block = "vision.blk.{}.".format(i), "{}encoder.layers.{}.".format(source, i)
        rows += _norm(target + "attn_norm", block + "layer_norm1", d)
        for ours, theirs in (
            ("attn_q", "q_proj"),
            ("attn_k", "k_proj"),
            ("attn_v", "v_proj"),
            ("attn_out", "out_proj"),
        ):
            rows += _linear(target + ours, block + "self_attn." + theirs, d, d, bias=True)
        rows += _norm(target + "ffn_norm", block + "layer_norm2", d)
        rows += _linear(target + "ffn_up", block + "mlp.fc1", s.d_vision_ff, d, bias=True)
        rows += _linear(target + "ffn_down", block + "mlp.fc2", d, s.d_vision_ff, bias=True)
    rows += _norm("vision.post_norm", source + "post_layernorm", d)
    return rows + _linear("connector", VLM + "connector.modality_projection.proj", s.d_model, d * s.factor**2)


def _block(target: str, block: str, d: int, d_q: int, d_kv: int, d_kv_in: int, d_ff: int) -> Dict[str, List[Weight]]:
    """The Llama block by part."""
    return {
        "attn_norm": _vector(target + "attn_norm.weight", block + "input_layernorm.weight", d),
        "attn_q": _linear(target + "attn_q", block + "self_attn.q_proj", d_q, d),
        "attn_k": _linear(target + "attn_k", block + "self_attn.k_proj", d_kv, d_kv_in),
        "attn_v": _linear(target + "attn_v", block + "self_attn.v_proj", d_kv, d_kv_in),
        "attn_out": _linear(target + "attn_out", block + "self_attn.o_proj", d, d_q),
        "ffn_norm": _vector(target + "ffn_norm.weight", block + "post_attention_layernorm.weight", d),
        "ffn_gate": _linear(target + "ffn_gate", block + "mlp.gate_proj", d_ff, d),
        "ffn_up": _linear(target + "ffn_up", block + "mlp.up_proj", d_ff, d),
        "ffn_down": _linear(target + "ffn_down", block + "mlp.down_proj", d, d_ff),
    }


KEPT_OF_LAST = ("attn_norm", "attn_k", "attn_v")


def _language_block(s: Sizes, i: int) -> Dict[str, List[Weight]]:
    d_kv = s.n_head_kv * s.d_head
    return _block(
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
        *_linear("state_in", "model.state_proj", s.d_model, s.d_state, bias=True),
        *_linear("action_in", "model.action_in_proj", d, s.d_action, bias=True),
        *_linear("action_time_in", "model.action_time_mlp_in", d, 2 * d, bias=True),
        *_linear("action_time_out", "model.action_time_mlp_out", d, d, bias=True),
    ]


def _expert(s: Sizes) -> List[Weight]:
    d_kv = s.n_head_kv * s.d_head
    rows: List[Weight] = []
    for j in range(s.n_expert_layer):
        block = _block(
            "expert.blk.{}.".format(j),
            "{}layers.{}.".format(EXPERT, j),
            s.d_expert,
            s.n_head * s.d_head,
            d_kv,
            s.d_kv_in[j],
            s.d_expert_ff,
        )
        rows += [weight for weights in block.values() for weight in weights]
    rows += _vector("expert.norm.weight", EXPERT + "norm.weight", s.d_expert)
    return rows + _linear("action_out", "model.action_out_proj", s.d_action, s.d_expert, bias=True)


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

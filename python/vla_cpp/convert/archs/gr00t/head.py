# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The action head: its part of a policy's config, its tensors, and its keys.

Self-attention over the features, where there is one; a diffusion transformer; encoders and a decoder with weights of their own for each
robot. Reference: Isaac-GR00T gr00t/model/modules/dit.py, embodiment_conditioned_mlp.py.
"""

from __future__ import annotations

from typing import Dict, List

from ...files import member
from ...layers import linear, norm
from ...networks import MAX_LAYERS
from ...section import Fixed, Section
from .. import MATRIX, TABLE, VECTOR, Weight
from .sizes import Sizes

HEAD = "action_head."
# DiT and SelfAttentionTransformer of gr00t/model/modules/dit.py.
TRANSFORMER = {"num_attention_heads": 8, "attention_head_dim": 64, "num_layers": 12, "output_dim": 26}
TRANSFORMER_FIXED: Fixed = {
    "attention_bias": (True, True),
    "activation_fn": ("gelu-approximate", "gelu-approximate"),
    "upcast_attention": (False, False),
    "positional_embeddings": ("sinusoidal", None),
}
DIT_FIXED: Fixed = {
    **TRANSFORMER_FIXED,
    "norm_type": ("ada_norm", "ada_norm"),
    "norm_elementwise_affine": (False, False),
    "norm_eps": (1e-5, 1e-5),
    "interleave_self_attention": (False, True),
}
TRANSFORMER_IGNORED = {
    "cross_attention_dim",  # checked by the shapes of keys and values
    "dropout",
    "final_dropout",
    "num_embeds_ada_norm",
    "max_num_positional_embeddings",
    "compute_dtype",
}


def read(policy: Section, s: Sizes) -> None:
    """`policy`: the members that describe the head; the language model's sizes are read already."""
    if "state_history_length" in policy.defaults:
        s.state_history = policy.count("state_history_length", maximum=64)
    s.d_state, s.horizon = policy.count("max_state_dim") * s.state_history, policy.count("action_horizon")
    s.d_hidden, s.n_position, s.n_embodiment = (policy.count(key) for key in ("hidden_size", "max_seq_len", "max_num_embodiments"))
    s.n_step, s.n_bucket = policy.count("num_inference_timesteps"), policy.count("num_timestep_buckets")
    if "rtc_ramp_rate" in policy.defaults:
        s.rtc_ramp_rate = policy.number("rtc_ramp_rate")
    if policy.count("backbone_embedding_dim") != s.lm.d_model:
        policy.bad("backbone_embedding_dim", "the language model's width {}".format(s.lm.d_model))
    if s.n_position < s.horizon:
        policy.bad("max_seq_len", "a row for each of the {} actions".format(s.horizon))
    _read_transformer(policy, s)
    _read_attention(policy, s)


def _transformer(policy: Section, key: str, fixed: Fixed) -> Section:
    where = "{}: {}".format(policy.where, key)
    section = Section(where, member({key: policy.get(key)}, key, dict, policy.where), TRANSFORMER, policy.problems)
    section.refuse_unknown({*TRANSFORMER, *fixed, *TRANSFORMER_IGNORED})
    section.check_fixed(fixed)
    return section


def _read_transformer(policy: Section, s: Sizes) -> None:
    dit = _transformer(policy, "diffusion_model_cfg", DIT_FIXED)
    s.n_dit_layer, s.n_dit_head = dit.count("num_layers", maximum=MAX_LAYERS), dit.count("num_attention_heads")
    s.d_dit, s.d_out = s.n_dit_head * dit.count("attention_head_dim"), dit.count("output_dim")
    if policy.count("input_embedding_dim") != s.d_dit:
        policy.bad("input_embedding_dim", "{}, the heads of diffusion_model_cfg side by side".format(s.d_dit))
    if s.d_dit % 2:
        policy.bad("input_embedding_dim", "an even number")
    if s.d_out != s.d_hidden:
        dit.bad("output_dim", "hidden_size {}, which the decoder reads".format(s.d_hidden))


def _read_attention(policy: Section, s: Sizes) -> None:
    """Absent, or without layers, the features pass as they are."""
    if not policy.get("vl_self_attention_cfg"):
        return
    attention = _transformer(policy, "vl_self_attention_cfg", TRANSFORMER_FIXED)
    s.n_vl_layer = attention.count("num_layers", minimum=0, maximum=MAX_LAYERS)
    if not s.n_vl_layer:
        return
    s.n_vl_head = attention.count("num_attention_heads")
    if s.n_vl_head * attention.count("attention_head_dim") != s.lm.d_model:
        attention.bad("num_attention_heads", "heads that make the language model's width {}".format(s.lm.d_model))


def weights(s: Sizes) -> List[Weight]:
    return [*_features(s), *transformer_rows(s), *_robot(s)]


def _attention_and_ffn(target: str, block: str, d: int, d_in: int, d_ff: int) -> List[Weight]:
    """`d_in`: width of what keys and values are made from."""
    rows: List[Weight] = []
    for ours, theirs, width in (("attn_q", "to_q", d), ("attn_k", "to_k", d_in), ("attn_v", "to_v", d_in), ("attn_out", "to_out.0", d)):
        rows += linear(target + ours, block + "attn1." + theirs, d, width, bias=True)
    rows += linear(target + "ffn_up", block + "ff.net.0.proj", d_ff, d, bias=True)
    return rows + linear(target + "ffn_down", block + "ff.net.2", d, d_ff, bias=True)


def _features(s: Sizes) -> List[Weight]:
    d, rows = s.lm.d_model, norm("vl.norm", HEAD + "vlln", s.lm.d_model)
    for i in range(s.n_vl_layer):
        target, block = "vl.blk.{}.".format(i), "{}vl_self_attention.transformer_blocks.{}.".format(HEAD, i)
        rows += norm(target + "attn_norm", block + "norm1", d) + norm(target + "ffn_norm", block + "norm3", d)
        rows += _attention_and_ffn(target, block, d, d, s.d_vl_ff)
    return rows


def transformer_rows(s: Sizes) -> List[Weight]:
    d, source = s.d_dit, HEAD + "model."
    time = source + "timestep_encoder.timestep_embedder."
    rows = linear("time_in", time + "linear_1", d, s.d_time, bias=True) + linear("time_out", time + "linear_2", d, d, bias=True)
    for i in range(s.n_dit_layer):
        target, block = "dit.blk.{}.".format(i), "{}transformer_blocks.{}.".format(source, i)
        rows += linear(target + "ada", block + "norm1.linear", 2 * d, d, bias=True)
        # Even blocks read the features, odd ones themselves.
        rows += _attention_and_ffn(target, block, d, d if i % 2 else s.lm.d_model, s.d_dit_ff)
    rows += linear("dit.out_ada", source + "proj_out_1", 2 * d, d, bias=True)
    return rows + linear("dit.out", source + "proj_out_2", s.d_out, d, bias=True)


def _of_robot(target: str, source: str, s: Sizes, d_out: int, d_in: int) -> List[Weight]:
    """The robot's part of a matrix that is stored for all of them, inputs before outputs."""
    pick = (0, s.embodiment)
    return [
        Weight(target + ".weight", source + ".W", MATRIX, (s.n_embodiment, d_in, d_out), (d_out, d_in), pick=pick, transpose=True),
        Weight(target + ".bias", source + ".b", VECTOR, (s.n_embodiment, d_out), (d_out,), pick=pick),
    ]


def _robot(s: Sizes) -> List[Weight]:
    d, table = s.d_dit, (s.n_position, s.d_dit)
    return [
        *_of_robot("state_in", HEAD + "state_encoder.layer1", s, s.d_hidden, s.d_state),
        *_of_robot("state_out", HEAD + "state_encoder.layer2", s, d, s.d_hidden),
        *_of_robot("action_in", HEAD + "action_encoder.W1", s, d, s.d_action),
        *_of_robot("action_mix", HEAD + "action_encoder.W2", s, d, 2 * d),
        *_of_robot("action_token", HEAD + "action_encoder.W3", s, d, d),
        Weight("action_position.weight", HEAD + "position_embedding.weight", TABLE, table, table),
        *_of_robot("decode_in", HEAD + "action_decoder.layer1", s, s.d_hidden, s.d_out),
        *_of_robot("decode_out", HEAD + "action_decoder.layer2", s, s.d_action, s.d_hidden),
    ]


def keys(s: Sizes) -> Dict[str, Dict[str, object]]:
    """By type. Numbers that no config states are literals of the reference."""
    u32 = {
        "policy.d_state": s.d_state * s.n_state_row,
        "policy.d_action": s.d_action,
        "policy.horizon": s.horizon,
        "policy.n_position": s.n_position,
        "policy.max_views": s.max_views,
        "vl.n_layer": s.n_vl_layer,
        "vl.n_head": s.n_vl_head,
        "vl.d_ff": s.d_vl_ff,
        "dit.d_model": s.d_dit,
        "dit.n_layer": s.n_dit_layer,
        "dit.n_head": s.n_dit_head,
        "dit.d_ff": s.d_dit_ff,
        "dit.d_out": s.d_out,
        "dit.d_time": s.d_time,
        "dit.n_bucket": s.n_bucket,
        "dit.d_hidden": s.d_hidden,
        "solver.steps": s.n_step,
    }
    f64: Dict[str, object] = {"solver.t_start": 0.0, "solver.t_end": 1.0}
    if s.rtc_ramp_rate is not None:
        f64["policy.rtc_ramp_rate"] = s.rtc_ramp_rate
    return {
        "u32": u32,
        "f32": {"vl.norm_eps": 1e-5, "dit.norm_eps": 1e-5, "dit.out_eps": 1e-6},
        "f64": f64,
        "string": {"solver.kind": "euler", "solver.noise": "normal"},
    }

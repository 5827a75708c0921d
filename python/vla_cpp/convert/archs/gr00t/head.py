# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The action head: its part of a policy's config, its tensors, and its keys.

The head has optional self-attention over the features, a diffusion transformer, and encoders and a decoder with separate weights per robot.
Reference: Isaac-GR00T gr00t/model/modules/dit.py, embodiment_conditioned_mlp.py.
"""

from __future__ import annotations

from typing import Dict, Mapping

from ...files import member
from ...layers import Names, Rows, block, linear, norm, table, vector
from ...networks import MAX_LAYERS, NORM_EPS, pick
from ...section import Fixed, Section
from .. import MATRIX, Weight
from .sizes import Sizes

HEAD = "action_head."
# Defaults of DiT and SelfAttentionTransformer in gr00t/model/modules/dit.py.
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
    "cross_attention_dim",  # the shapes of keys and values check it
    "dropout",
    "final_dropout",
    "num_embeds_ada_norm",
    "max_num_positional_embeddings",
    "compute_dtype",
}


def read(policy: Section, s: Sizes) -> None:
    """Reads the head's sizes; those of the language model must be set already. `policy`: the members that describe the head."""
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
    """Reads the self-attention over the features. If it is absent or has no layers, the features pass unchanged."""
    if not policy.get("vl_self_attention_cfg"):
        return
    attention = _transformer(policy, "vl_self_attention_cfg", TRANSFORMER_FIXED)
    s.n_vl_layer = attention.count("num_layers", minimum=0, maximum=MAX_LAYERS)
    if not s.n_vl_layer:
        return
    s.n_vl_head = attention.count("num_attention_heads")
    if s.n_vl_head * attention.count("attention_head_dim") != s.lm.d_model:
        attention.bad("num_attention_heads", "heads that make the language model's width {}".format(s.lm.d_model))


BLOCK = Names("attn1.to_q attn1.to_k attn1.to_v attn1.to_out.0", "ff.net.0.proj ff.net.2")


def weights(s: Sizes) -> Rows:
    return [*_features(s), *transformer_rows(s), *_robot(s)]


def _features(s: Sizes) -> Rows:
    d, rows = s.lm.d_model, norm("vl.norm", HEAD + "vlln", s.lm.d_model)
    for i in range(s.n_vl_layer):
        target, source = "vl.blk.{}.".format(i), "{}vl_self_attention.transformer_blocks.{}.".format(HEAD, i)
        rows += norm(target + "attn_norm", source + "norm1", d) + norm(target + "ffn_norm", source + "norm3", d)
        rows += block(target, source, BLOCK, d, s.d_vl_ff)
    return rows


def transformer_rows(s: Sizes) -> Rows:
    d, source = s.d_dit, HEAD + "model."
    time = source + "timestep_encoder.timestep_embedder."
    rows = linear("time_in", time + "linear_1", d, s.d_time) + linear("time_out", time + "linear_2", d, d)
    for i in range(s.n_dit_layer):
        target, theirs = "dit.blk.{}.".format(i), "{}transformer_blocks.{}.".format(source, i)
        # Even blocks have cross-attention to the features, odd ones self-attention.
        rows += linear(target + "ada", theirs + "norm1.linear", 2 * d, d)
        rows += block(target, theirs, BLOCK, d, s.d_dit_ff, d if i % 2 else s.lm.d_model)
    return rows + linear("dit.out_ada", source + "proj_out_1", 2 * d, d) + linear("dit.out", source + "proj_out_2", s.d_out, d)


def _of_robot(target: str, source: str, s: Sizes, d_out: int, d_in: int) -> Rows:
    """The robot's layer in a tensor that stacks those of all robots, each matrix as (in, out)."""
    pick, n = (0, s.embodiment), s.n_embodiment
    matrix = Weight(target + ".weight", source + ".W", MATRIX, (n, d_in, d_out), (d_out, d_in), pick=pick, transpose=True)
    return [matrix, *vector(target + ".bias", source + ".b", d_out, (n, d_out), pick=pick)]


def _robot(s: Sizes) -> Rows:
    d, encoder = s.d_dit, HEAD + "action_encoder."
    return [
        *_of_robot("state_in", HEAD + "state_encoder.layer1", s, s.d_hidden, s.d_state),
        *_of_robot("state_out", HEAD + "state_encoder.layer2", s, d, s.d_hidden),
        *_of_robot("action_in", encoder + "W1", s, d, s.d_action),
        *_of_robot("action_mix", encoder + "W2", s, d, 2 * d),
        *_of_robot("action_token", encoder + "W3", s, d, d),
        *table("action_position", HEAD + "position_embedding.weight", s.n_position, d),
        *_of_robot("decode_in", HEAD + "action_decoder.layer1", s, s.d_hidden, s.d_out),
        *_of_robot("decode_out", HEAD + "action_decoder.layer2", s, s.d_action, s.d_hidden),
    ]


def keys(s: Sizes) -> Dict[str, Mapping[str, object]]:
    """Key values by module. Numbers that no config states are literals of the reference."""
    dit = dict(d_model=s.d_dit, n_layer=s.n_dit_layer, n_head=s.n_dit_head, d_ff=s.d_dit_ff, **pick(s, "d_out d_time n_bucket d_hidden"))
    return {
        "policy": dict(d_state=s.d_state * s.n_state_row, **pick(s, "d_action horizon n_position max_views")),
        "vl": dict(n_layer=s.n_vl_layer, n_head=s.n_vl_head, d_ff=s.d_vl_ff, norm_eps=NORM_EPS),
        "dit": dict(dit, norm_eps=NORM_EPS, out_eps=1e-6),
        "solver": dict(steps=s.n_step, t_start=0.0, t_end=1.0, kind="euler", noise="normal"),
    }

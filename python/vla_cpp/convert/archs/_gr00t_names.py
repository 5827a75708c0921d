# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Tensors of GR00T N1.7: Qwen3-VL, the attention over its features, and a diffusion transformer whose ends each robot has of its own."""

from __future__ import annotations

from typing import List

from . import MATRIX, TABLE, VECTOR, Dropped, Weight
from ._gr00t_sizes import Sizes
from ._rows import gated_block, linear, norm, vector

BACKBONE, HEAD = "backbone.model.", "action_head."
VISUAL, LM = BACKBONE + "model.visual.", BACKBONE + "model.language_model."


def weights(s: Sizes) -> List[Weight]:
    return [*_vision(s), *_language(s), *_features(s), *_transformer(s), *_robot(s)]


def dropped(s: Sizes) -> List[Dropped]:
    return [
        Dropped(LM + "norm.weight", (s.d_model,), "final language norm: the action head reads the last layer as it is before it"),
        Dropped(BACKBONE + "lm_head.weight", (s.n_vocab, s.d_model), "language head"),
    ]


def _patch(target: str, s: Sizes, time: int) -> Weight:
    """One time slice of the convolution, whose stride is its kernel: a matrix over channel, row, column."""
    side, source = s.patch_size, VISUAL + "patch_embed.proj.weight"
    return Weight(target, source, MATRIX, (s.d_vision, 3, 2, side, side), (s.d_vision, 3 * side**2), pick=(2, time))


def _third(target: str, source: str, d: int, i: int) -> List[Weight]:
    """The i-th of q, k and v, which are stacked."""
    return [
        Weight(target + ".weight", source + ".weight", MATRIX, (3 * d, d), (d, d), first=i * d),
        Weight(target + ".bias", source + ".bias", VECTOR, (3 * d,), (d,), first=i * d),
    ]


def _merger(target: str, source: str, s: Sizes, d_norm: int) -> List[Weight]:
    d = 4 * s.d_vision
    return [
        *norm(target + "norm", source + "norm", d_norm),
        *linear(target + "up", source + "linear_fc1", d, d, bias=True),
        *linear(target + "down", source + "linear_fc2", s.d_model, d, bias=True),
    ]


def _vision(s: Sizes) -> List[Weight]:
    d, table = s.d_vision, (s.n_position_side**2, s.d_vision)
    rows = [
        _patch("vision.patch_embed.weight", s, 0),
        _patch("vision.patch_embed_next.weight", s, 1),
        *vector("vision.patch_embed.bias", VISUAL + "patch_embed.proj.bias", d),
        Weight("vision.position.weight", VISUAL + "pos_embed.weight", TABLE, table, table),
    ]
    for i in range(s.n_vision_layer):
        target, block = "vision.blk.{}.".format(i), "{}blocks.{}.".format(VISUAL, i)
        rows += norm(target + "attn_norm", block + "norm1", d)
        for part, name in enumerate(("attn_q", "attn_k", "attn_v")):
            rows += _third(target + name, block + "attn.qkv", d, part)
        rows += linear(target + "attn_out", block + "attn.proj", d, d, bias=True)
        rows += norm(target + "ffn_norm", block + "norm2", d)
        rows += linear(target + "ffn_up", block + "mlp.linear_fc1", s.d_vision_ff, d, bias=True)
        rows += linear(target + "ffn_down", block + "mlp.linear_fc2", d, s.d_vision_ff, bias=True)
    rows += _merger("connector.", VISUAL + "merger.", s, d)
    for k in range(len(s.deepstack_layers)):
        rows += _merger("deepstack.{}.".format(k), "{}deepstack_merger_list.{}.".format(VISUAL, k), s, 4 * d)
    return rows


def _language(s: Sizes) -> List[Weight]:
    table = (s.n_vocab, s.d_model)
    rows = [Weight("lm.token_embd.weight", LM + "embed_tokens.weight", TABLE, table, table)]
    d_q, d_kv = s.n_head * s.d_head, s.n_head_kv * s.d_head
    for i in range(s.n_layer):
        target, block = "lm.blk.{}.".format(i), "{}layers.{}.".format(LM, i)
        for part in gated_block(target, block, s.d_model, d_q, d_kv, s.d_model, s.d_ff).values():
            rows += part
        rows += vector(target + "attn_q_norm.weight", block + "self_attn.q_norm.weight", s.d_head)
        rows += vector(target + "attn_k_norm.weight", block + "self_attn.k_norm.weight", s.d_head)
    return rows


def _attention_and_ffn(target: str, block: str, d: int, d_in: int, d_ff: int) -> List[Weight]:
    """`d_in`: width of what keys and values are made from."""
    rows: List[Weight] = []
    for ours, theirs, width in (("attn_q", "to_q", d), ("attn_k", "to_k", d_in), ("attn_v", "to_v", d_in), ("attn_out", "to_out.0", d)):
        rows += linear(target + ours, block + "attn1." + theirs, d, width, bias=True)
    rows += linear(target + "ffn_up", block + "ff.net.0.proj", d_ff, d, bias=True)
    return rows + linear(target + "ffn_down", block + "ff.net.2", d, d_ff, bias=True)


def _features(s: Sizes) -> List[Weight]:
    d, rows = s.d_model, norm("vl.norm", HEAD + "vlln", s.d_model)
    for i in range(s.n_vl_layer):
        target, block = "vl.blk.{}.".format(i), "{}vl_self_attention.transformer_blocks.{}.".format(HEAD, i)
        rows += norm(target + "attn_norm", block + "norm1", d) + norm(target + "ffn_norm", block + "norm3", d)
        rows += _attention_and_ffn(target, block, d, d, s.d_vl_ff)
    return rows


def _transformer(s: Sizes) -> List[Weight]:
    d, source = s.d_dit, HEAD + "model."
    time = source + "timestep_encoder.timestep_embedder."
    rows = linear("time_in", time + "linear_1", d, s.d_time, bias=True) + linear("time_out", time + "linear_2", d, d, bias=True)
    for i in range(s.n_dit_layer):
        target, block = "dit.blk.{}.".format(i), "{}transformer_blocks.{}.".format(source, i)
        rows += linear(target + "ada", block + "norm1.linear", 2 * d, d, bias=True)
        # Even blocks read the features, odd ones themselves.
        rows += _attention_and_ffn(target, block, d, d if i % 2 else s.d_model, s.d_dit_ff)
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

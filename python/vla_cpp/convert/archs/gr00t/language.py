# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The language model, a Qwen3 of which the policy keeps the first layers: its part of a config, its tensors, and its keys."""

from __future__ import annotations

from typing import Dict, List

from ...files import member
from ...layers import gated_block, vector
from ...section import Fixed, Section
from .. import TABLE, Weight
from .sizes import MAX_LAYERS, Sizes

TEXT_FIXED: Fixed = {"hidden_act": ("silu", "silu"), "attention_bias": (False, False)}


def read(text: Section, kept: int, s: Sizes) -> None:
    """`kept`: layers from the first on that the policy keeps. The rotary keys are the caller's."""
    text.check_fixed(TEXT_FIXED)
    s.d_model, s.d_ff, s.n_vocab = text.count("hidden_size"), text.count("intermediate_size"), text.count("vocab_size")
    s.n_layer, s.n_head = min(kept, text.count("num_hidden_layers", most=MAX_LAYERS)), text.count("num_attention_heads")
    text.nullable = ("num_key_value_heads",)
    if text.values.get("num_key_value_heads", 0) is None:
        text.defaults["num_key_value_heads"] = s.n_head
    s.n_head_kv, s.d_head = text.count("num_key_value_heads"), text.count("head_dim")
    s.lm_eps, s.n_context = text.number("rms_norm_eps"), text.count("max_position_embeddings")
    if s.n_head % s.n_head_kv or s.d_head % 2:
        text.bad("num_attention_heads", "heads of an even width in whole groups of {}".format(s.n_head_kv))


def rope_section(text: Section, defaults: dict) -> Section:
    """Either spelling of transformers: rope_parameters, or rope_scaling beside rope_theta."""
    key = "rope_scaling" if text.get("rope_parameters") is None else "rope_parameters"
    values = member(text.values, key, dict, text.where)
    return Section("{}: {}".format(text.where, key), values, defaults, text.problems)


def weights(s: Sizes, source: str) -> List[Weight]:
    """`source`: where its tensors stand, up to the dot."""
    table = (s.n_vocab, s.d_model)
    rows = [Weight("lm.token_embd.weight", source + "embed_tokens.weight", TABLE, table, table)]
    d_q, d_kv = s.n_head * s.d_head, s.n_head_kv * s.d_head
    for i in range(s.n_layer):
        target, block = "lm.blk.{}.".format(i), "{}layers.{}.".format(source, i)
        for part in gated_block(target, block, s.d_model, d_q, d_kv, s.d_model, s.d_ff).values():
            rows += part
        rows += vector(target + "attn_q_norm.weight", block + "self_attn.q_norm.weight", s.d_head)
        rows += vector(target + "attn_k_norm.weight", block + "self_attn.k_norm.weight", s.d_head)
    return rows


def keys(s: Sizes) -> Dict[str, Dict[str, object]]:
    u32 = {
        "lm.d_model": s.d_model,
        "lm.n_layer": s.n_layer,
        "lm.n_head": s.n_head,
        "lm.n_head_kv": s.n_head_kv,
        "lm.d_head": s.d_head,
        "lm.d_ff": s.d_ff,
        "lm.n_vocab": s.n_vocab,
    }
    return {"u32": u32, "f32": {"lm.norm_eps": s.lm_eps, "lm.rope_base": s.rope_base}}

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The config of the language model, a Qwen3 of which the policy keeps only the first layers."""

from __future__ import annotations

from ...files import member
from ...networks import defaults, read_language
from ...section import Fixed, Section
from .sizes import Sizes

# Common defaults of transformers' Qwen3Config and Qwen3VLTextConfig, which differ in two other keys.
TEXT = defaults(4096, 22016, 32, 32, vocab_size=151936, num_key_value_heads=32, head_dim=128, rms_norm_eps=1e-6)
TEXT_FIXED: Fixed = {"hidden_act": ("silu", "silu"), "attention_bias": (False, False)}


def read(text: Section, kept: int, s: Sizes) -> None:
    """Reads the config. `kept`: number of first layers that the policy keeps. The caller reads the rotary keys."""
    text.check_fixed(TEXT_FIXED)
    text.nullable = ("num_key_value_heads",)
    s.lm = read_language(text)
    s.lm.n_layer, s.n_context = min(kept, s.lm.n_layer), text.count("max_position_embeddings")
    if s.lm.n_head % s.lm.n_head_kv or s.lm.d_head % 2:
        text.bad("num_attention_heads", "heads of an even width in whole groups of {}".format(s.lm.n_head_kv))


def rope_section(text: Section, defaults: dict) -> Section:
    """The rotary settings in either form of transformers: rope_parameters, or rope_scaling beside rope_theta."""
    key = "rope_scaling" if text.get("rope_parameters") is None else "rope_parameters"
    values = member(text.values, key, dict, text.where)
    return Section("{}: {}".format(text.where, key), values, defaults, text.problems)

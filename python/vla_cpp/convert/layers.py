# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Rows of mappings that several architectures share: single tensors, the SigLIP tower, the gated block of Llama and Gemma."""

from __future__ import annotations

from typing import Dict, List

from .archs import MATRIX, SCALE, TABLE, TERNARY, VECTOR, Weight


def linear(target: str, source: str, d_out: int, d_in: int, bias: bool = False) -> List[Weight]:
    rows = [Weight(target + ".weight", source + ".weight", MATRIX, (d_out, d_in), (d_out, d_in))]
    return rows + (vector(target + ".bias", source + ".bias", d_out) if bias else [])


def ternary(target: str, source: str, d_out: int, d_in: int, bias: bool = False) -> List[Weight]:
    """A matrix that the reference rounds to -1, 0 and 1 times a factor, four numbers in a byte."""
    rows = [
        Weight(target + ".weight", source + ".weight", TERNARY, (d_out, d_in), (d_out, d_in // 4)),
        Weight(target + ".scale", source + ".weight", SCALE, (d_out, d_in), (1,)),
    ]
    return rows + (vector(target + ".bias", source + ".bias", d_out) if bias else [])


def vector(target: str, source: str, size: int) -> List[Weight]:
    return [Weight(target, source, VECTOR, (size,), (size,))]


def norm(target: str, source: str, size: int) -> List[Weight]:
    return vector(target + ".weight", source + ".weight", size) + vector(target + ".bias", source + ".bias", size)


def siglip(
    source: str, d: int, d_ff: int, n_layer: int, patch_size: int, n_position: int, product=linear, post_norm: bool = True
) -> List[Weight]:
    """The tower below `source`, which ends in a dot, as `vision.*`. `product`: the kind of its blocks' matrices."""
    pixels = 3 * patch_size**2
    rows = [
        # A convolution whose stride is its kernel is a matrix over the flattened patch: channel, row, column.
        Weight(
            "vision.patch_embed.weight",
            source + "embeddings.patch_embedding.weight",
            MATRIX,
            (d, 3, patch_size, patch_size),
            (d, pixels),
        ),
        *vector("vision.patch_embed.bias", source + "embeddings.patch_embedding.bias", d),
        Weight(
            "vision.position.weight",
            source + "embeddings.position_embedding.weight",
            TABLE,
            (n_position, d),
            (n_position, d),
        ),
    ]
    for i in range(n_layer):
        target, block = "vision.blk.{}.".format(i), "{}encoder.layers.{}.".format(source, i)
        rows += norm(target + "attn_norm", block + "layer_norm1", d)
        for ours, theirs in (
            ("attn_q", "q_proj"),
            ("attn_k", "k_proj"),
            ("attn_v", "v_proj"),
            ("attn_out", "out_proj"),
        ):
            rows += product(target + ours, block + "self_attn." + theirs, d, d, bias=True)
        rows += norm(target + "ffn_norm", block + "layer_norm2", d)
        rows += product(target + "ffn_up", block + "mlp.fc1", d_ff, d, bias=True)
        rows += product(target + "ffn_down", block + "mlp.fc2", d, d_ff, bias=True)
    return rows + (norm("vision.post_norm", source + "post_layernorm", d) if post_norm else [])


def gated_block(
    target: str, block: str, d: int, d_q: int, d_kv: int, d_kv_in: int, d_ff: int, product=linear
) -> Dict[str, List[Weight]]:
    """The block of Llama and Gemma by part. `product`: the kind of its matrices."""
    return {
        "attn_norm": vector(target + "attn_norm.weight", block + "input_layernorm.weight", d),
        "attn_q": product(target + "attn_q", block + "self_attn.q_proj", d_q, d),
        "attn_k": product(target + "attn_k", block + "self_attn.k_proj", d_kv, d_kv_in),
        "attn_v": product(target + "attn_v", block + "self_attn.v_proj", d_kv, d_kv_in),
        "attn_out": product(target + "attn_out", block + "self_attn.o_proj", d, d_q),
        "ffn_norm": vector(target + "ffn_norm.weight", block + "post_attention_layernorm.weight", d),
        "ffn_gate": product(target + "ffn_gate", block + "mlp.gate_proj", d_ff, d),
        "ffn_up": product(target + "ffn_up", block + "mlp.up_proj", d_ff, d),
        "ffn_down": product(target + "ffn_down", block + "mlp.down_proj", d, d_ff),
    }


# Of the last layer of a prefix only keys and values are read.
KEPT_OF_LAST = ("attn_norm", "attn_k", "attn_v")

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Rows of mappings that several architectures share: single tensors, the SigLIP tower, the gated block of Llama and Gemma."""

from __future__ import annotations

from typing import Dict, List, NamedTuple, Sequence

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


class EncoderNames(NamedTuple):
    """Parts of a layer. `qkv`: three names, or a single one that ends before "weight" where their rows are stacked. `scales`: LayerScale."""

    norms: Sequence[str]
    qkv: Sequence[str]
    out: str
    up: str
    down: str
    scales: Sequence[str] = ()


def encoder_block(target: str, block: str, names: EncoderNames, d: int, d_ff: int, product=linear) -> List[Weight]:
    """`product`: the kind of its matrices."""

    def branch(i: int, part: str, rows: List[Weight]) -> List[Weight]:
        scale = vector(target + part + "_scale.weight", block + names.scales[i], d) if names.scales else []
        return [*norm(target + part + "_norm", block + names.norms[i], d), *rows, *scale]

    qkv = (
        stacked(target, block + names.qkv[0], d)
        if len(names.qkv) == 1
        else [row for part, name in zip("qkv", names.qkv) for row in product(target + "attn_" + part, block + name, d, d, bias=True)]
    )
    up = product(target + "ffn_up", block + names.up, d_ff, d, bias=True)
    return [
        *branch(0, "attn", [*qkv, *product(target + "attn_out", block + names.out, d, d, bias=True)]),
        *branch(1, "ffn", [*up, *product(target + "ffn_down", block + names.down, d, d_ff, bias=True)]),
    ]


def stacked(target: str, source: str, d: int) -> List[Weight]:
    """q, k and v of width d as thirds of the rows of one matrix and one bias."""
    rows: List[Weight] = []
    for i, part in enumerate(("attn_q", "attn_k", "attn_v")):
        rows += [
            Weight(target + part + ".weight", source + "weight", MATRIX, (3 * d, d), (d, d), first=i * d),
            Weight(target + part + ".bias", source + "bias", VECTOR, (3 * d,), (d,), first=i * d),
        ]
    return rows


SIGLIP = EncoderNames(
    ("layer_norm1", "layer_norm2"), tuple("self_attn.{}_proj".format(part) for part in "qkv"), "self_attn.out_proj", "mlp.fc1", "mlp.fc2"
)


def siglip(
    source: str, d: int, d_ff: int, n_layer: int, patch_size: int, n_position: int, product=linear, post_norm: bool = True
) -> List[Weight]:
    """The tower below `source`, which ends in a dot, as `vision.*`. `product`: the kind of its blocks' matrices."""
    patches, table = source + "embeddings.patch_embedding", (n_position, d)
    rows = [
        # A convolution whose stride is its kernel is a matrix over the flattened patch: channel, row, column.
        Weight("vision.patch_embed.weight", patches + ".weight", MATRIX, (d, 3, patch_size, patch_size), (d, 3 * patch_size**2)),
        *vector("vision.patch_embed.bias", patches + ".bias", d),
        Weight("vision.position.weight", source + "embeddings.position_embedding.weight", TABLE, table, table),
    ]
    for i in range(n_layer):
        rows += encoder_block("vision.blk.{}.".format(i), "{}encoder.layers.{}.".format(source, i), SIGLIP, d, d_ff, product)
    return rows + (norm("vision.post_norm", source + "post_layernorm", d) if post_norm else [])


def gated_block(target: str, block: str, d: int, d_q: int, d_kv: int, d_kv_in: int, d_ff: int, product=linear) -> Dict[str, List[Weight]]:
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

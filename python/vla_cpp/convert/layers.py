# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Rows of mappings, with shapes: single tensors, and blocks that several architectures share. Each mapping gives a checkpoint's names for
the parts of a block."""

from __future__ import annotations

from typing import Callable, List, NamedTuple, Sequence, Tuple

from .archs import MATRIX, SCALE, TABLE, TERNARY, VECTOR, Weight

Rows = List[Weight]


def linear(target: str, source: str, d_out: int, d_in: int, bias: bool = True) -> Rows:
    rows = [Weight(target + ".weight", source + ".weight", MATRIX, (d_out, d_in), (d_out, d_in))]
    return rows + (vector(target + ".bias", source + ".bias", d_out) if bias else [])


def ternary(target: str, source: str, d_out: int, d_in: int, bias: bool = True) -> Rows:
    """A matrix that the reference rounds to -1, 0 or 1 times a factor; stored with four numbers per byte."""
    rows = [
        Weight(target + ".weight", source + ".weight", TERNARY, (d_out, d_in), (d_out, d_in // 4)),
        Weight(target + ".scale", source + ".weight", SCALE, (d_out, d_in), (1,)),
    ]
    return rows + (vector(target + ".bias", source + ".bias", d_out) if bias else [])


def vector(target: str, source: str, size: int, stored: Tuple[int, ...] = (), **how) -> Rows:
    return [Weight(target, source, VECTOR, stored or (size,), (size,), **how)]


def table(target: str, source: str, n_row: int, d: int, stored: Tuple[int, ...] = (), **how) -> Rows:
    """A table. `source`: the full tensor name, since names of plain parameters do not end in "weight"."""
    return [Weight(target + ".weight", source, TABLE, stored or (n_row, d), (n_row, d), **how)]


def norm(target: str, source: str, d: int) -> Rows:
    return vector(target + ".weight", source + ".weight", d) + vector(target + ".bias", source + ".bias", d)


def rms_norm(target: str, source: str, d: int) -> Rows:
    return vector(target + ".weight", source + ".weight", d)


def gemma_norm(target: str, source: str, d: int) -> Rows:
    return vector(target + ".weight", source + ".weight", d, plus_one=True)


def patch_embed(source: str, d: int, size: int) -> Rows:
    """The patch embedding: a convolution whose stride equals its kernel size is a matrix over the flattened patch (channel, row, column)."""
    stored, at = (d, 3, size, size), "vision.patch_embed"
    return [Weight(at + ".weight", source + ".weight", MATRIX, stored, (d, 3 * size**2)), *vector(at + ".bias", source + ".bias", d)]


class Names(NamedTuple):
    """A checkpoint's names for the parts of a block, separated by blanks.

    attn    q, k, v and the output projection; if q, k and v are stacked in one tensor: its name up to "weight" or "bias", and the projection
    ffn     up, down
    cross   a second attention
    norms   the norms of attention, of cross-attention if there is one, and of the MLP; empty without norms
    scales  the LayerScale factors, in the same order; empty without them
    """

    attn: str
    ffn: str
    norms: str = ""
    cross: str = ""
    scales: str = ""


SIGLIP = Names("self_attn.q_proj self_attn.k_proj self_attn.v_proj self_attn.out_proj", "mlp.fc1 mlp.fc2", "layer_norm1 layer_norm2")


def attention(target: str, source: str, names: str, d: int, d_in: int = 0, product=linear) -> Rows:
    """An attention. `d_in`: width of the input of keys and values, by default d."""
    *qkv, out = names.split()
    if len(qkv) == 1:
        rows = stacked(target, source + qkv[0], d)
    else:
        parts = zip("qkv", qkv, (d, d_in or d, d_in or d))
        rows = [row for part, name, width in parts for row in product(target + "attn_" + part, source + name, d, width)]
    return rows + product(target + "attn_out", source + out, d, d)


def stacked(target: str, source: str, d: int) -> Rows:
    """q, k and v of width d, which are stacked as the thirds of one matrix's and one bias's rows."""
    rows: Rows = []
    for i, part in enumerate(("attn_q", "attn_k", "attn_v")):
        rows += [
            Weight(target + part + ".weight", source + "weight", MATRIX, (3 * d, d), (d, d), first=i * d),
            Weight(target + part + ".bias", source + "bias", VECTOR, (3 * d,), (d,), first=i * d),
        ]
    return rows


def block(target: str, source: str, names: Names, d: int, d_ff: int, d_in: int = 0, product=linear) -> Rows:
    """A block: self-attention, cross-attention if `names.cross` is set, and an MLP."""
    (up, down), norms, scales = names.ffn.split(), names.norms.split(), names.scales.split()
    parts = [("attn", attention(target, source, names.attn, d, d_in, product))]
    if names.cross:
        parts.append(("cross.attn", attention(target + "cross.", source, names.cross, d)))
    parts.append(("ffn", product(target + "ffn_up", source + up, d_ff, d) + product(target + "ffn_down", source + down, d, d_ff)))
    rows: Rows = []
    for i, (part, own) in enumerate(parts):
        rows += norm(target + part + "_norm", source + norms[i], d) if norms else []
        rows += own
        rows += vector(target + part + "_scale.weight", source + scales[i], d) if scales else []
    return rows


def blocks(target: str, source: str, names: Names, n_layer: int, d: int, d_ff: int, product=linear) -> Rows:
    """Blocks of all layers. `source`: prefix up to the dot, with {} for the layer's number."""
    layers = ((target + "blk.{}.".format(i), source.format(i)) for i in range(n_layer))
    return [row for at, theirs in layers for row in block(at, theirs, names, d, d_ff, product=product)]


class Decoder(NamedTuple):
    """The differences between the blocks of Llama, Qwen, Gemma and BitNet."""

    norm: Callable[..., Rows] = rms_norm
    product: Callable[..., Rows] = linear
    qkv_bias: bool = False
    sub_norms: bool = False  # norms before the last product of attention and of the MLP
    head_norms: bool = False  # norms of queries and keys, per head


LLAMA, GEMMA, QWEN2, QWEN3 = Decoder(), Decoder(gemma_norm), Decoder(qkv_bias=True), Decoder(head_norms=True)
BITNET = Decoder(product=ternary, sub_norms=True)


def gated_block(target: str, source: str, d: int, d_ff: int, heads: Sequence[int], kind: Decoder = LLAMA, d_in: int = 0) -> Rows:
    """A decoder block with a gated MLP. `heads`: widths of queries, of keys and of a head. `d_in`: width of the input of keys and values, by
    default d."""
    (d_q, d_kv, d_head), at, mlp, rows = (
        heads,
        source + "self_attn.",
        source + "mlp.",
        kind.norm(target + "attn_norm", source + "input_layernorm", d),
    )
    for part, d_out, width in (("q", d_q, d), ("k", d_kv, d_in or d), ("v", d_kv, d_in or d)):
        rows += kind.product(target + "attn_" + part, at + part + "_proj", d_out, width, bias=kind.qkv_bias)
    rows += kind.product(target + "attn_out", at + "o_proj", d, d_q, bias=False)
    rows += rms_norm(target + "attn_sub_norm", at + "attn_sub_norm", d_q) if kind.sub_norms else []
    rows += kind.norm(target + "ffn_norm", source + "post_attention_layernorm", d)
    for part, d_out, width in (("gate", d_ff, d), ("up", d_ff, d), ("down", d, d_ff)):
        rows += kind.product(target + "ffn_" + part, mlp + part + "_proj", d_out, width, bias=False)
    rows += rms_norm(target + "ffn_sub_norm", mlp + "ffn_sub_norm", d_ff) if kind.sub_norms else []
    for part in ("q", "k") if kind.head_norms else ():
        rows += rms_norm(target + "attn_{}_norm".format(part), at + part + "_norm", d_head)
    return rows

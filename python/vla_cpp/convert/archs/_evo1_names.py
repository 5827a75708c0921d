# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Tensors of Evo-1: the authors' names and LeRobot's, which differ in the towers and not in the head."""

from __future__ import annotations

from typing import List, NamedTuple, Sequence

from . import MATRIX, TABLE, VECTOR, Weight
from ._evo1_sizes import N_TIME, Sizes
from ._rows import gated_block, linear, norm, vector


class Names(NamedTuple):
    """Modules of a tower by what they are. `qkv`: one name where q, k and v are stacked, which ends before "weight" and "bias",
    else three."""

    vision: str
    class_token: str
    position: str
    patch: str
    block: str
    norms: Sequence[str]
    qkv: Sequence[str]
    out: str
    scales: Sequence[str]
    connector: Sequence[str]
    lm: str
    head: str


AUTHORS = Names(
    vision="embedder.model.vision_model.",
    class_token="embeddings.class_embedding",
    position="embeddings.position_embedding",
    patch="embeddings.patch_embedding",
    block="encoder.layers.{}.",
    norms=("norm1", "norm2"),
    qkv=("attn.qkv.",),
    out="attn.proj",
    scales=("ls1", "ls2"),
    connector=tuple("embedder.model.mlp1." + part for part in "013"),
    lm="embedder.model.language_model.model.",
    head="action_head.",
)
LEROBOT = Names(
    vision="model.embedder.model.vision_tower.",
    class_token="embeddings.cls_token",
    position="embeddings.position_embeddings",
    patch="embeddings.patch_embeddings.projection",
    block="encoder.layer.{}.",
    norms=("layernorm_before", "layernorm_after"),
    qkv=tuple("attention.{}_proj".format(part) for part in "qkv"),
    out="attention.projection_layer",
    scales=("lambda_1", "lambda_2"),
    connector=tuple("model.embedder.model.multi_modal_projector." + part for part in ("layer_norm", "linear_1", "linear_2")),
    lm="model.embedder.model.language_model.",
    head="model.action_head.",
)


def weights(s: Sizes, names: Names) -> List[Weight]:
    return [*_vision(s, names), *_connector(s, names), *_language(s, names), *_head(s, names.head)]


def _stacked(target: str, source: str, d: int) -> List[Weight]:
    """q, k and v of width d as thirds of the rows of one matrix and one bias. `source`: their name up to "weight" and "bias"."""
    rows: List[Weight] = []
    for i, part in enumerate(("attn_q", "attn_k", "attn_v")):
        rows += [
            Weight(target + part + ".weight", source + "weight", MATRIX, (3 * d, d), (d, d), first=i * d),
            Weight(target + part + ".bias", source + "bias", VECTOR, (3 * d,), (d,), first=i * d),
        ]
    return rows


def _qkv(target: str, block: str, names: Sequence[str], d: int) -> List[Weight]:
    if len(names) == 1:
        return _stacked(target, block + names[0], d)
    return [row for part, name in zip("qkv", names) for row in linear(target + "attn_" + part, block + name, d, d, bias=True)]


def _vision(s: Sizes, names: Names) -> List[Weight]:
    d, patch, n_position = s.d_vision, s.patch_size, (s.image_size // s.patch_size) ** 2 + 1
    source = names.vision + names.patch
    rows = [
        Weight("vision.class_token.weight", names.vision + names.class_token, VECTOR, (1, 1, d), (d,)),
        # A convolution whose stride is its kernel is a matrix over the flattened patch: channel, row, column.
        Weight("vision.patch_embed.weight", source + ".weight", MATRIX, (d, 3, patch, patch), (d, 3 * patch**2)),
        *vector("vision.patch_embed.bias", source + ".bias", d),
        Weight("vision.position.weight", names.vision + names.position, TABLE, (1, n_position, d), (n_position, d)),
    ]
    for i in range(s.n_vision_layer):
        target, block = "vision.blk.{}.".format(i), names.vision + names.block.format(i)
        rows += norm(target + "attn_norm", block + names.norms[0], d)
        rows += _qkv(target, block, names.qkv, d)
        rows += linear(target + "attn_out", block + names.out, d, d, bias=True)
        rows += vector(target + "attn_scale.weight", block + names.scales[0], d)
        rows += norm(target + "ffn_norm", block + names.norms[1], d)
        rows += linear(target + "ffn_up", block + "mlp.fc1", s.d_vision_ff, d, bias=True)
        rows += linear(target + "ffn_down", block + "mlp.fc2", d, s.d_vision_ff, bias=True)
        rows += vector(target + "ffn_scale.weight", block + names.scales[1], d)
    return rows


def _connector(s: Sizes, names: Names) -> List[Weight]:
    first, up, down = names.connector
    return [
        *norm("connector.norm", first, 4 * s.d_vision),
        *linear("connector.up", up, s.d_model, 4 * s.d_vision, bias=True),
        *linear("connector.down", down, s.d_model, s.d_model, bias=True),
    ]


def _language(s: Sizes, names: Names) -> List[Weight]:
    rows = [Weight("lm.token_embd.weight", names.lm + "embed_tokens.weight", TABLE, (s.n_vocab, s.d_model), (s.n_vocab, s.d_model))]
    d_q, d_kv = s.n_head * s.d_head, s.n_head_kv * s.d_head
    widths = {"attn_q": d_q, "attn_k": d_kv, "attn_v": d_kv}
    for i in range(s.n_layer):
        target, block = "lm.blk.{}.".format(i), "{}layers.{}.".format(names.lm, i)
        for part, parts in gated_block(target, block, s.d_model, d_q, d_kv, s.d_model, s.d_ff).items():
            rows += parts
            if part in widths:
                rows += vector(target + part + ".bias", parts[0].source[: -len("weight")] + "bias", widths[part])
    return rows + vector("lm.norm.weight", names.lm + "norm.weight", s.d_model)


def _table(target: str, source: str, n_row: int, d: int) -> Weight:
    """Sines and cosines, which are no parameters: stored in float32 they stay so, whatever the matrices are."""
    return Weight(target, source, TABLE, (1, n_row, d), (n_row, d), keep_f32=True)


def _head(s: Sizes, head: str) -> List[Weight]:
    d, encoder, out = s.d_model, head + "action_encoder.", s.horizon * s.d_action
    rows = [
        *linear("state_in", head + "state_encoder.fc1.linear", s.d_state_hidden, s.d_state, bias=True),
        *linear("state_out", head + "state_encoder.fc2.linear", d, s.d_state_hidden, bias=True),
        _table("time.weight", head + "time_pos_enc.pe", N_TIME, d),
        *linear("action_in", encoder + "W1.linear", d, s.d_action, bias=True),
        *linear("action_mix", encoder + "W2.linear", d, d, bias=True),
        *linear("action_token", encoder + "W3.linear", d, d, bias=True),
        _table("action_position.weight", encoder + "pos_encoding.pe", s.horizon, d),
    ]
    for i in range(s.n_head_layer):
        target, block = "head.blk.{}.".format(i), "{}transformer_blocks.{}.".format(head, i)
        rows += norm(target + "attn_norm", block + "norm1", d)
        rows += _stacked(target, block + "attn.in_proj_", d)
        rows += linear(target + "attn_out", block + "attn.out_proj", d, d, bias=True)
        rows += norm(target + "ffn_norm", block + "norm2", d)
        rows += linear(target + "ffn_up", block + "ff.0", 4 * d, d, bias=True)
        rows += linear(target + "ffn_down", block + "ff.2", d, 4 * d, bias=True)
    return [
        *rows,
        *norm("head.norm", head + "norm_out", d),
        *linear("pool", head + "seq_pool_proj", d, s.horizon * d, bias=True),
        *linear("velocity_in", head + "mlp_head.fc1.linear", s.d_hidden, d, bias=True),
        *linear("velocity_out", head + "mlp_head.fc2.linear", out, s.d_hidden, bias=True),
    ]

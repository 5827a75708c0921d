# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Keys of the network and names of every tensor of X-VLA."""

from __future__ import annotations

import re
from typing import Dict, List

from ...bundle import Key
from ...layers import Names, Rows, block, blocks, linear, norm, table, vector
from ...networks import NORM_EPS, keys_of, pick
from .. import MATRIX, VECTOR, Dropped, Weight
from .config import Sizes, Stage

VLM, HEAD = "model.vlm.", "model.transformer."
TOWER, PROJECTOR, ENCODER = VLM + "vision_tower.", VLM + "multi_modal_projector.", VLM + "language_model.encoder."
POSITION_OFFSET = 2  # rows before the first position (transformers modeling_bart.py BartLearnedPositionalEmbedding)
DAVIT = {
    kind: Names("{0}.qkv. {0}.proj".format(attention), "ffn.fc1 ffn.fc2", "norm1 norm2")
    for kind, attention in (("spatial", "window_attn"), ("channel", "channel_attn"))
}
BART = Names("self_attn.q_proj self_attn.k_proj self_attn.v_proj self_attn.out_proj", "fc1 fc2", "self_attn_layer_norm final_layer_norm")
BLOCK = Names("attn.qkv. attn.proj", "mlp.fc1 mlp.fc2", "norm1 norm2")
# transformers' names of Florence-2's parts -> names in the authors' own code; the inverse of the reference's
# _remap_vendored_florence_state_dict (modeling_xvla.py).
VENDORED = [
    (r"(\.convs\.\d+)\.conv\.", r"\1.proj."),
    (r"(_block)\.(conv[12])\.", r"\1.\2.fn.dw."),
    (r"(spatial_block)\.norm1\.", r"\1.window_attn.norm."),
    (r"(channel_block)\.norm1\.", r"\1.channel_attn.norm."),
    (r"(_block)\.norm2\.", r"\1.ffn.norm."),
    (r"\.(window_attn|channel_attn)\.(qkv|proj)\.", r".\1.fn.\2."),
    (r"(_block)\.ffn\.(fc[12])\.", r"\1.ffn.fn.net.\2."),
    (r"multi_modal_projector\.image_proj_norm\.", "image_proj_norm."),
    (r"multi_modal_projector\.image_position_embed\.", "image_pos_embed."),
    (r"multi_modal_projector\.visual_temporal_embed\.", "visual_temporal_embed."),
    (r"\.language_model\.", ".language_model.model."),
]


def network_keys(s: Sizes) -> List[Key]:
    frame = dict(image_width=s.frame[0], image_height=s.frame[1], n_position=s.n_cell_position)
    stages = {name: [int(getattr(stage, name)) for stage in s.stages] for name in Stage._fields}
    sizes = pick(s, "d_model n_layer n_head d_ff d_time n_prompt n_position")
    return keys_of(
        {
            "policy": pick(s, "d_state d_action horizon n_view n_token pad_token grippers"),
            "vision": dict(window=s.window, **frame, norm_eps=NORM_EPS, **stages),
            "lm": s.lm,
            "transformer": dict(sizes, norm_eps=NORM_EPS),
            "solver": dict(kind="renoise", steps=s.n_step, noise="normal"),
        }
    )


def weights(s: Sizes) -> Rows:
    d, d_token = s.d_model, s.d_action + s.d_state + s.d_time
    rows = [
        *_florence(s),
        *norm("transformer.norm", HEAD + "norm", d),
        *blocks("transformer.", HEAD + "blocks.{}.", BLOCK, s.n_layer, d, s.d_ff),
        *table("position", HEAD + "pos_emb", s.n_position, d, (1, s.n_position, d)),
    ]
    for target, source in (("vlm_in", "vlm_proj"), ("aux_in", "aux_visual_proj")):
        rows += of_domain(target, HEAD + source, d, s.lm.d_model, s) if s.hetero else linear(target, HEAD + source, d, s.lm.d_model)
    rows += of_domain("action_in", HEAD + "action_encoder", d, d_token, s)
    rows += of_domain("action_out", HEAD + "action_decoder", s.d_action, d, s)
    if s.n_prompt:
        stored = (s.n_domain, s.n_prompt * d)
        rows += table("prompt", HEAD + "soft_prompt_hub.weight", s.n_prompt, d, stored, pick=(0, s.domain))
    return [row._replace(in_bf16=s.in_bf16) for row in rows]


def of_domain(target: str, source: str, d_out: int, d_in: int, s: Sizes) -> Rows:
    """The domain's own layer: each row of a table is the matrix (in, out) of one domain."""
    pick = (0, s.domain)
    return [
        Weight(target + ".weight", source + ".fc.weight", MATRIX, (s.n_domain, d_in * d_out), (d_out, d_in), pick=pick, regroup=d_out),
        Weight(target + ".bias", source + ".bias.weight", VECTOR, (s.n_domain, d_out), (d_out,), pick=pick),
    ]


def _florence(s: Sizes) -> Rows:
    rows = [*_tower(s), *_projector(s), *_encoder(s)]
    return [_vendored(row, s) for row in rows] if s.vendored else rows


def _vendored(row: Weight, s: Sizes) -> Weight:
    """The row with the name in the authors' code, where the projection is a plain parameter (in, out)."""
    if row.source == PROJECTOR + "image_projection.weight":
        return row._replace(source=VLM + "image_projection", stored=row.stored[::-1], transpose=True)
    return row._replace(source=row.source if row.source == s.tokens else old_name(row.source))


def old_name(source: str) -> str:
    for today, before in VENDORED:
        source = re.sub(today, before, source, count=1)
    return source


def _tower(s: Sizes) -> Rows:
    rows, d_in = [], 3
    for i, stage in enumerate(s.stages):
        d, size, here, conv = stage.d_model, stage.patch_size, "vision.stage.{}.".format(i), "{}convs.{}.".format(TOWER, i)
        stored, shape = (d, d_in, size, size), (d, size * size * d_in)
        rows += [
            Weight(here + "embed.conv.weight", conv + "conv.weight", MATRIX, stored, shape, axes=(0, 2, 3, 1)),
            *vector(here + "embed.conv.bias", conv + "conv.bias", d),
            *norm(here + "embed.norm", conv + "norm", d_in if stage.pre_norm else d),
        ]
        for b, (kind, names) in ((b, item) for b in range(stage.n_layer) for item in DAVIT.items()):
            target, source = "{}blk.{}.{}.".format(here, b, kind), "{}blocks.{}.{}.{}_block.".format(TOWER, i, b, kind)
            rows += block(target, source, names, d, stage.d_ff)
            for name in ("conv1", "conv2"):
                rows += vector(target + name + ".kernel", source + name + ".weight", 9 * d, (d, 1, 3, 3), axes=(1, 2, 3, 0))
                rows += vector(target + name + ".bias", source + name + ".bias", d)
        d_in = d
    return rows


def _projector(s: Sizes) -> Rows:
    d, n, cell = s.stages[-1].d_model, s.n_cell_position, PROJECTOR + "image_position_embed."
    return [
        *linear("projector", PROJECTOR + "image_projection", s.lm.d_model, d, bias=False),
        *norm("projector.norm", PROJECTOR + "image_proj_norm", s.lm.d_model),
        *table("row", cell + "row_embeddings.weight", n, d // 2),
        *table("column", cell + "column_embeddings.weight", n, d - d // 2),
        # Only the first moment is used: there is one frame.
        *vector("temporal.weight", PROJECTOR + "visual_temporal_embed.pos_idx_to_embed", d, (s.n_moment, d), pick=(0, 0)),
    ]


def _encoder(s: Sizes) -> Rows:
    lm, d = s.lm, s.lm.d_model
    stored = (lm.n_position + POSITION_OFFSET, d)
    return [
        *table("lm.token_embd", s.tokens, lm.n_vocab, d),
        *table("lm.position", ENCODER + "embed_positions.weight", lm.n_position, d, stored, first=POSITION_OFFSET),
        *norm("lm.embd_norm", ENCODER + "layernorm_embedding", d),
        *blocks("lm.", ENCODER + "layers.{}.", BART, lm.n_layer, d, lm.d_ff),
    ]


def dropped(s: Sizes) -> List[Dropped]:
    tokens, at = (s.lm.n_vocab, s.lm.d_model), VLM + "language_model."
    names = [old_name(at + name) if s.vendored else at + name for name in ("shared.weight", "encoder.embed_tokens.weight")]
    return [
        *(Dropped(name, tokens, "the same table as " + s.tokens) for name in names if name != s.tokens),
        Dropped(at + "final_logits_bias", (1, s.lm.n_vocab), "the policy generates no text"),
    ]


def hints(s: Sizes) -> Dict[str, str]:
    return {
        TOWER + "blocks.": "depths of the vision_config are {}".format([stage.n_layer for stage in s.stages]),
        old_name(ENCODER) if s.vendored else ENCODER: "encoder_layers is {}".format(s.lm.n_layer),
        VLM + "language_model.": "the policy reads the encoder alone",
        HEAD + "blocks.": "depth is {}".format(s.n_layer),
        HEAD + "soft_prompt_hub": "len_soft_prompts is {}".format(s.n_prompt),
    }

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Keys of the network and names, storage and shapes of every tensor of X-VLA."""

from __future__ import annotations

import re
from typing import Dict, List

from ...bundle import Key
from ...layers import EncoderNames, encoder_block, linear, norm, vector
from ...networks import keys_of
from .. import MATRIX, TABLE, VECTOR, Dropped, Weight
from .config import Sizes, Stage

VLM, HEAD = "model.vlm.", "model.transformer."
TOWER, PROJECTOR, ENCODER = VLM + "vision_tower.", VLM + "multi_modal_projector.", VLM + "language_model.encoder."
NORM_EPS = 1e-5  # of torch.nn.LayerNorm
POSITION_OFFSET = 2  # rows in front of the first position (transformers modeling_bart.py BartLearnedPositionalEmbedding)
DAVIT = {"spatial": "window_attn", "channel": "channel_attn"}
BART = EncoderNames(
    ("self_attn_layer_norm", "final_layer_norm"),
    tuple("self_attn.{}_proj".format(part) for part in "qkv"),
    "self_attn.out_proj",
    "fc1",
    "fc2",
)
BLOCK = EncoderNames(("norm1", "norm2"), ("attn.qkv.",), "attn.proj", "mlp.fc1", "mlp.fc2")
# transformers' names of Florence-2's parts -> those of the authors' own code, whose inverse is the reference's
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
    keys = keys_of(
        {
            "policy": dict(
                d_state=s.d_state, d_action=s.d_action, horizon=s.horizon, n_view=s.n_view, n_token=s.n_token, pad_token=s.pad_token
            ),
            "vision": dict(
                window=s.window, image_width=s.frame[0], image_height=s.frame[1], n_position=s.n_cell_position, norm_eps=NORM_EPS
            ),
            "lm": dict(
                d_model=s.d_lm,
                n_layer=s.n_lm_layer,
                n_head=s.n_lm_head,
                d_ff=s.d_lm_ff,
                n_vocab=s.n_vocab,
                n_position=s.n_lm_position,
                norm_eps=NORM_EPS,
            ),
            "transformer": dict(
                d_model=s.d_model,
                n_layer=s.n_layer,
                n_head=s.n_head,
                d_ff=s.d_ff,
                d_time=s.d_time,
                n_prompt=s.n_prompt,
                n_position=s.n_position,
                norm_eps=NORM_EPS,
            ),
            "solver": dict(kind="renoise", steps=s.n_step, noise="normal"),
        }
    )
    lists = {name: [int(getattr(stage, name)) for stage in s.stages] for name in Stage._fields}
    return [
        *keys,
        Key("policy.grippers", "u32[]", s.grippers),
        *(Key("vision." + name, "u32[]", numbers) for name, numbers in lists.items()),
    ]


def weights(s: Sizes) -> List[Weight]:
    d, d_token = s.d_model, s.d_action + s.d_state + s.d_time
    rows = [*_florence(s), *norm("transformer.norm", HEAD + "norm", d)]
    for i in range(s.n_layer):
        rows += encoder_block("transformer.blk.{}.".format(i), "{}blocks.{}.".format(HEAD, i), BLOCK, d, s.d_ff)
    rows.append(Weight("position.weight", HEAD + "pos_emb", TABLE, (1, s.n_position, d), (s.n_position, d)))
    for target, source in (("vlm_in", "vlm_proj"), ("aux_in", "aux_visual_proj")):
        rows += of_domain(target, HEAD + source, d, s.d_lm, s) if s.hetero else linear(target, HEAD + source, d, s.d_lm, bias=True)
    rows += of_domain("action_in", HEAD + "action_encoder", d, d_token, s)
    rows += of_domain("action_out", HEAD + "action_decoder", s.d_action, d, s)
    if s.n_prompt:
        stored = (s.n_domain, s.n_prompt * d)
        rows.append(Weight("prompt.weight", HEAD + "soft_prompt_hub.weight", TABLE, stored, (s.n_prompt, d), pick=(0, s.domain)))
    return [row._replace(in_bf16=s.in_bf16) for row in rows]


def of_domain(target: str, source: str, d_out: int, d_in: int, s: Sizes) -> List[Weight]:
    """A layer that each domain has of its own: a row of a table is its matrix (in, out)."""
    pick = (0, s.domain)
    return [
        Weight(target + ".weight", source + ".fc.weight", MATRIX, (s.n_domain, d_in * d_out), (d_out, d_in), pick=pick, regroup=d_out),
        Weight(target + ".bias", source + ".bias.weight", VECTOR, (s.n_domain, d_out), (d_out,), pick=pick),
    ]


def _florence(s: Sizes) -> List[Weight]:
    rows = [*_tower(s), *_projector(s), *_encoder(s)]
    return [_vendored(row, s) for row in rows] if s.vendored else rows


def _vendored(row: Weight, s: Sizes) -> Weight:
    """The authors' projection is a matrix (in, out) without a module."""
    if row.source == PROJECTOR + "image_projection.weight":
        return row._replace(source=VLM + "image_projection", stored=row.stored[::-1], transpose=True)
    return row._replace(source=row.source if row.source == s.tokens else old_name(row.source))


def old_name(source: str) -> str:
    for today, before in VENDORED:
        source = re.sub(today, before, source, count=1)
    return source


def _tower(s: Sizes) -> List[Weight]:
    rows, d_in = [], 3
    for i, stage in enumerate(s.stages):
        d, size, here, conv = stage.d_model, stage.patch_size, "vision.stage.{}.".format(i), "{}convs.{}.".format(TOWER, i)
        stored, shape = (d, d_in, size, size), (d, size * size * d_in)
        rows += [
            Weight(here + "embed.conv.weight", conv + "conv.weight", MATRIX, stored, shape, axes=(0, 2, 3, 1)),
            *vector(here + "embed.conv.bias", conv + "conv.bias", d),
            *norm(here + "embed.norm", conv + "norm", d_in if stage.pre_norm else d),
        ]
        for b in range(stage.n_layer):
            for kind, attention in DAVIT.items():
                names = EncoderNames(("norm1", "norm2"), (attention + ".qkv.",), attention + ".proj", "ffn.fc1", "ffn.fc2")
                target, source = "{}blk.{}.{}.".format(here, b, kind), "{}blocks.{}.{}.{}_block.".format(TOWER, i, b, kind)
                rows += encoder_block(target, source, names, d, stage.d_ff)
                for name in ("conv1", "conv2"):
                    kernel = (d, 1, 3, 3)
                    rows.append(Weight(target + name + ".kernel", source + name + ".weight", VECTOR, kernel, (9 * d,), axes=(1, 2, 3, 0)))
                    rows += vector(target + name + ".bias", source + name + ".bias", d)
        d_in = d
    return rows


def _projector(s: Sizes) -> List[Weight]:
    d, n = s.stages[-1].d_model, s.n_cell_position
    half = d // 2
    return [
        *linear("projector", PROJECTOR + "image_projection", s.d_lm, d),
        *norm("projector.norm", PROJECTOR + "image_proj_norm", s.d_lm),
        Weight("row.weight", PROJECTOR + "image_position_embed.row_embeddings.weight", TABLE, (n, half), (n, half)),
        Weight("column.weight", PROJECTOR + "image_position_embed.column_embeddings.weight", TABLE, (n, d - half), (n, d - half)),
        # A frame is the first moment, and there is no other.
        Weight("temporal.weight", PROJECTOR + "visual_temporal_embed.pos_idx_to_embed", VECTOR, (s.n_moment, d), (d,), pick=(0, 0)),
    ]


def _encoder(s: Sizes) -> List[Weight]:
    d, table = s.d_lm, (s.n_vocab, s.d_lm)
    stored = (s.n_lm_position + POSITION_OFFSET, d)
    position = Weight("lm.position.weight", ENCODER + "embed_positions.weight", TABLE, stored, (s.n_lm_position, d), first=POSITION_OFFSET)
    rows = [
        Weight("lm.token_embd.weight", s.tokens, TABLE, table, table),
        position,
        *norm("lm.embd_norm", ENCODER + "layernorm_embedding", d),
    ]
    for i in range(s.n_lm_layer):
        rows += encoder_block("lm.blk.{}.".format(i), "{}layers.{}.".format(ENCODER, i), BART, d, s.d_lm_ff)
    return rows


def dropped(s: Sizes) -> List[Dropped]:
    table, at = (s.n_vocab, s.d_lm), VLM + "language_model."
    names = [old_name(at + name) if s.vendored else at + name for name in ("shared.weight", "encoder.embed_tokens.weight")]
    return [
        *(Dropped(name, table, "the same table as " + s.tokens) for name in names if name != s.tokens),
        Dropped(at + "final_logits_bias", (1, s.n_vocab), "the policy generates no text"),
    ]


def hints(s: Sizes) -> Dict[str, str]:
    return {
        TOWER + "blocks.": "depths of the vision_config are {}".format([stage.n_layer for stage in s.stages]),
        old_name(ENCODER) if s.vendored else ENCODER: "encoder_layers is {}".format(s.n_lm_layer),
        VLM + "language_model.": "the policy reads the encoder alone",
        HEAD + "blocks.": "depth is {}".format(s.n_layer),
        HEAD + "soft_prompt_hub": "len_soft_prompts is {}".format(s.n_prompt),
    }

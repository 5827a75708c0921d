# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Keys of the network and names of every tensor of the authors' TurboVLA."""

from __future__ import annotations

from typing import Dict, List

from ...bundle import Key
from ...layers import Names, Rows, block, blocks, linear, norm, patch_embed, table, vector
from ...networks import NORM_EPS, keys_of, pick
from .. import Dropped
from ..turbovla.mapping import BERT, DINOV3
from .config import BACKBONE, Sizes

LANGUAGE, PROJECTION = "text_encoder.bert.", "vision_projection."
FUSION, STATE, DECODER = "vision_language_interaction.", "action_head.state_projection.", "action_head.decoder."
AMONG = Names("self_attn.in_proj_ self_attn.out_proj", "linear1 linear2", "norm1 norm2")
DECODED = Names(
    "self_attn.in_proj_ self_attn.out_proj", "linear1 linear2", "norm1 norm2 norm3", cross="multihead_attn.in_proj_ multihead_attn.out_proj"
)
# The two streams of a fusion layer -> the suffix of their tensors.
SIDES = {"image": "v", "text": "l"}


def network_keys(s: Sizes) -> List[Key]:
    policy = pick(s, "d_state d_action horizon n_row sentences padding places vision_tokens d_hidden")
    return keys_of(
        {
            "policy": dict(policy, n_view=len(s.views)),
            "vision": {**vars(s.vision), **pick(s, "rope_base n_register")},
            "lm": s.lm,
            "projector": dict(d_hidden=s.d_projector),
            "state_in": dict(n_token=s.n_state_token, d_hidden=s.d_state_hidden),
            "transformer": dict(pick(s, "d_model n_head d_ff"), activation="relu", norm="before", norm_eps=NORM_EPS),
            "fusion": dict(n_layer=s.n_fusion, n_head=s.n_fusion_head, d_inner=s.d_inner, residual=s.residual),
            "decoder": dict(n_layer=s.n_decoder),
            "solver": dict(steps=1, kind="direct", noise="none"),
        }
    )


def weights(s: Sizes) -> Rows:
    d = s.d_model
    rows = [
        *_vision(s),
        *_language(s),
        *_projector(s),
        *linear("text_in", "text_encoder.text_projection", d, s.lm.d_model),
        *_places(s),
        *_state(s),
        *table("query", DECODER + "action_queries.weight", s.horizon, d),
        *linear("action_in", DECODER + "action_projection.layers.0", s.d_hidden, d),
        *linear("action_mid", DECODER + "action_projection.layers.1", s.d_hidden, s.d_hidden),
        *linear("action_out", DECODER + "action_projection.layers.2", s.d_action, s.d_hidden),
    ]
    for i in range(s.n_fusion):
        at = "fusion.blk.{}.".format(i)
        rows += _both(at, "{}fusion_layers.{}.".format(FUSION, i), s)
        rows += block(at + "among.", "{}text_layers.{}.".format(FUSION, i), AMONG, d, s.d_inner)
    return rows + blocks("decoder.", DECODER + "decoder.layers.{}.", DECODED, s.n_decoder, d, s.d_ff)


def _both(target: str, source: str, s: Sizes) -> Rows:
    """A layer in which image and text attend to each other."""
    rows: Rows = []
    for side, theirs in SIDES.items():
        at = target + side + "."
        rows += norm(at + "attn_norm", source + "layer_norm_" + theirs, s.d_model)
        for name, part in (("attn_qk", "{}_proj"), ("attn_v", "values_{}_proj")):
            rows += linear(at + name, source + "attn." + part.format(theirs), s.d_inner, s.d_model)
        rows += linear(at + "attn_out", source + "attn.out_{}_proj".format(theirs), s.d_model, s.d_inner)
        rows += vector(at + "attn_scale.weight", source + "gamma_" + theirs, s.d_model)
    return rows


def _projector(s: Sizes) -> Rows:
    d_in, d = s.vision.d_model, s.d_model
    return [
        *norm("projector.norm", PROJECTION + "input_norm", d_in),
        *linear("projector.up", PROJECTION + "mlp.0", s.d_projector, d_in),
        *linear("projector.down", PROJECTION + "mlp.3", d, s.d_projector),
        *linear("projector.skip", PROJECTION + "skip", d, d_in, bias=False),
        *norm("projector.out_norm", PROJECTION + "output_norm", d),
    ]


def _places(s: Sizes) -> Rows:
    """The embeddings that are added to the patches: one per view, and one per patch of each view."""
    d, n_view, n_patch = s.d_model, len(s.views), s.vision.n_patch
    if s.places == "views":
        return table("camera", "view_embedding", n_view, d, (1, n_view, d))
    return [
        *table("camera", "view_embedding", n_view, d, (1, n_view, 1, d)),
        *table("place", "patch_position_embedding", n_view * n_patch, d, (1, n_view, n_patch, d)),
        *vector("place_scale.weight", "patch_position_scale", n_view, (1, n_view, 1, 1)),
    ]


def _state(s: Sizes) -> Rows:
    d, n_token = s.d_model, s.n_state_token
    return [
        *norm("state_in.norm", STATE + "net.0", s.d_state),
        *linear("state_in.up", STATE + "net.1", s.d_state_hidden, s.d_state),
        *linear("state_in.down", STATE + "net.4", n_token * d, s.d_state_hidden),
        *table("state_in.place", STATE + "position", n_token, d, (1, n_token, d)),
        *norm("state_in.out_norm", STATE + "output_norm", d),
    ]


def _vision(s: Sizes) -> Rows:
    v, at = s.vision, BACKBONE + "embeddings."
    rows = blocks("vision.", BACKBONE + s.layers + ".{}.", DINOV3, v.n_layer, v.d_model, v.d_ff)
    return [
        *patch_embed(at + "patch_embeddings", v.d_model, v.patch_size),
        *vector("vision.class_token.weight", at + "cls_token", v.d_model, (1, 1, v.d_model)),
        *(norm("vision.post_norm", BACKBONE + "norm", v.d_model) if s.vision_tokens == "normed" else []),
        *(table("vision.registers", at + "register_tokens", s.n_register, v.d_model, (1, s.n_register, v.d_model)) if s.n_register else []),
        *(row for row in rows if not row.target.endswith("attn_k.bias")),
    ]


def _language(s: Sizes) -> Rows:
    lm, at = s.lm, LANGUAGE + "embeddings."
    return [
        *table("lm.token_embd", at + "word_embeddings.weight", lm.n_vocab, lm.d_model),
        *table("lm.position", at + "position_embeddings.weight", lm.n_position, lm.d_model),
        # An instruction has the first sentence type.
        *vector("lm.sentence.weight", at + "token_type_embeddings.weight", lm.d_model, (s.n_sentence, lm.d_model), pick=(0, 0)),
        *norm("lm.embd_norm", at + "LayerNorm", lm.d_model),
        *blocks("lm.", LANGUAGE + "encoder.layer.{}.", BERT, lm.n_layer, lm.d_model, lm.d_ff),
    ]


def dropped(s: Sizes) -> List[Dropped]:
    d, d_lm = s.vision.d_model, s.lm.d_model
    pooler, last = "the policy reads every token, not their summary", "the policy was trained on the tokens before it (--vision-tokens)"
    norms = [] if s.vision_tokens == "normed" else [Dropped(BACKBONE + "norm." + part, (d,), last) for part in ("weight", "bias")]
    return [
        Dropped(BACKBONE + "embeddings.mask_token", (1, 1, d), "patches are masked in training alone"),
        *([] if s.n_register else [Dropped(BACKBONE + "embeddings.register_tokens", (1, 0, d), "there are no registers")]),
        *norms,
        Dropped(LANGUAGE + "pooler.dense.weight", (d_lm, d_lm), pooler),
        Dropped(LANGUAGE + "pooler.dense.bias", (d_lm,), pooler),
    ]


def hints(s: Sizes) -> Dict[str, str]:
    return {
        BACKBONE + s.layers + ".": "num_hidden_layers of the vision backbone is {}".format(s.vision.n_layer),
        LANGUAGE + "encoder.layer.": "num_hidden_layers of the language backbone is {}".format(s.lm.n_layer),
        FUSION: "num_layers of interaction is {}".format(s.n_fusion),
        DECODER + "decoder.layers.": "num_layers of action is {}".format(s.n_decoder),
        "patch_position_": "position_embedding is view" if s.places == "views" else "",
    }

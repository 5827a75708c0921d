# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Keys of the network and names of every tensor of TurboVLA."""

from __future__ import annotations

from typing import Dict, List

from ...bundle import Key
from ...layers import Names, Rows, block, blocks, linear, norm, patch_embed, table, vector
from ...networks import NORM_EPS, keys_of, pick
from .. import Dropped
from .config import Sizes

VISION, LANGUAGE = "model.vision_encoder.", "model.language_encoder."
FUSION, DECODER = "model.vl_interaction.", "model.action_decoder."
DINOV3 = Names(
    "attention.q_proj attention.k_proj attention.v_proj attention.o_proj",
    "mlp.up_proj mlp.down_proj",
    "norm1 norm2",
    scales="layer_scale1.lambda1 layer_scale2.lambda1",
)
BERT = Names(
    "attention.self.query attention.self.key attention.self.value attention.output.dense",
    "intermediate.dense output.dense",
    "attention.output.LayerNorm output.LayerNorm",
)


def _attention(name: str) -> str:
    return " ".join("{}.{}_proj".format(name, part) for part in ("q", "k", "v", "out"))


FUSED = {
    "image": Names(_attention("text_to_vision_attn"), "vision_ffn.linear1 vision_ffn.linear2", "norm_vision_attn norm_vision_ffn"),
    "text": Names(_attention("vision_to_text_attn"), "text_ffn.linear1 text_ffn.linear2", "norm_text_attn norm_text_ffn"),
}
DECODED = Names(
    _attention("self_attn"), "ffn.linear1 ffn.linear2", "norm_self_attn norm_cross_attn norm_ffn", cross=_attention("cross_attn")
)


def network_keys(s: Sizes) -> List[Key]:
    return keys_of(
        {
            "policy": dict(pick(s, "d_state d_action horizon"), n_view=len(s.views)),
            "vision": {**vars(s.vision), **pick(s, "rope_base n_register")},
            "lm": s.lm,
            "transformer": dict(pick(s, "d_model n_head d_ff activation"), norm="before", norm_eps=NORM_EPS),
            "fusion": dict(n_layer=s.n_fusion),
            "decoder": dict(n_layer=s.n_decoder),
            "solver": dict(steps=1, kind="direct", noise="none"),
        }
    )


def weights(s: Sizes) -> Rows:
    d, n_patch = s.d_model, s.vision.n_patch
    rows = [
        *_vision(s),
        *_language(s),
        *linear("projector", "model.vision_proj", d, s.vision.d_model),
        *linear("text_in", "model.language_proj", d, s.lm.d_model),
        *table("position", "model.patch_pos_embed", n_patch, d, (1, n_patch, d)),
        *table("camera", "model.camera_embed.weight", len(s.views), d),
        *norm("fusion.image_norm", FUSION + "norm_vision", d),
        *norm("fusion.text_norm", FUSION + "norm_text", d),
        *table("query", DECODER + "query_embed.weight", s.horizon, d),
        *norm("decoder.norm", DECODER + "norm", d),
        *linear("action_out", DECODER + "action_head", s.d_action, d),
    ]
    if s.d_state:
        rows += linear("state_in", "model.state_proj", d, s.d_state)
        rows += vector("state_token.weight", "model.state_embed", d, (1, 1, d))
    for i in range(s.n_fusion):
        for part, names in FUSED.items():
            rows += block("fusion.blk.{}.{}.".format(i, part), "{}layers.{}.".format(FUSION, i), names, d, s.d_ff)
    return rows + blocks("decoder.", DECODER + "layers.{}.", DECODED, s.n_decoder, d, s.d_ff)


def _vision(s: Sizes) -> Rows:
    v, at = s.vision, VISION + "embeddings."
    registers = (1, s.n_register, v.d_model)
    rows = blocks("vision.", VISION + "model.layer.{}.", DINOV3, v.n_layer, v.d_model, v.d_ff)
    return [
        *patch_embed(at + "patch_embeddings", v.d_model, v.patch_size),
        *vector("vision.class_token.weight", at + "cls_token", v.d_model, (1, 1, v.d_model)),
        *norm("vision.post_norm", VISION + "norm", v.d_model),
        *(table("vision.registers", at + "register_tokens", s.n_register, v.d_model, registers) if s.n_register else []),
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
    pooler = "the policy reads every token, not their summary"
    return [
        Dropped(VISION + "embeddings.mask_token", (1, 1, s.vision.d_model), "patches are masked in training alone"),
        *([] if s.n_register else [Dropped(VISION + "embeddings.register_tokens", (1, 0, s.vision.d_model), "there are no registers")]),
        Dropped(LANGUAGE + "pooler.dense.weight", (s.lm.d_model, s.lm.d_model), pooler),
        Dropped(LANGUAGE + "pooler.dense.bias", (s.lm.d_model,), pooler),
    ]


def hints(s: Sizes) -> Dict[str, str]:
    return {
        VISION + "model.layer.": "num_hidden_layers of the vision backbone is {}".format(s.vision.n_layer),
        LANGUAGE + "encoder.layer.": "num_hidden_layers of the language backbone is {}".format(s.lm.n_layer),
        "model.vl_interaction.layers.": "n_fusion_layers is {}".format(s.n_fusion),
        "model.action_decoder.layers.": "n_decoder_layers is {}".format(s.n_decoder),
        "model.state_": "config.json has no observation.state" if not s.d_state else "",
    }

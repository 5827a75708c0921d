# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Keys of the network and names, storage and shapes of every tensor of TurboVLA."""

from __future__ import annotations

from typing import Dict, List

from ...bundle import Key
from ...layers import EncoderNames, encoder_block, linear, norm, vector
from ...networks import keys_of
from .. import MATRIX, TABLE, VECTOR, Dropped, Weight
from .config import Sizes

VISION, LANGUAGE = "model.vision_encoder.", "model.language_encoder."
NORM_EPS = 1e-5  # of torch.nn.LayerNorm
QKV = ("q_proj", "k_proj", "v_proj", "out_proj")
DINOV3 = EncoderNames(
    ("norm1", "norm2"),
    tuple("attention.{}_proj".format(part) for part in "qkv"),
    "attention.o_proj",
    "mlp.up_proj",
    "mlp.down_proj",
    ("layer_scale1.lambda1", "layer_scale2.lambda1"),
)
BERT = EncoderNames(
    ("attention.output.LayerNorm", "output.LayerNorm"),
    tuple("attention.self." + part for part in ("query", "key", "value")),
    "attention.output.dense",
    "intermediate.dense",
    "output.dense",
)


def network_keys(s: Sizes) -> List[Key]:
    return keys_of(
        {
            "policy": dict(d_state=s.d_state, d_action=s.d_action, horizon=s.horizon, n_view=len(s.views)),
            "vision": {**vars(s.vision), "rope_base": s.rope_base, "n_register": s.n_register},
            "lm": vars(s.lm),
            "transformer": dict(d_model=s.d_model, n_head=s.n_head, d_ff=s.d_ff, activation=s.activation, norm="before", norm_eps=NORM_EPS),
            "fusion": dict(n_layer=s.n_fusion),
            "decoder": dict(n_layer=s.n_decoder),
            "solver": dict(steps=1, kind="direct", noise="none"),
        }
    )


def weights(s: Sizes) -> List[Weight]:
    d, fusion, decoder = s.d_model, "model.vl_interaction.", "model.action_decoder."
    rows = [
        *_vision(s),
        *_language(s),
        *linear("projector", "model.vision_proj", d, s.vision.d_model, bias=True),
        *linear("text_in", "model.language_proj", d, s.lm.d_model, bias=True),
        Weight("position.weight", "model.patch_pos_embed", TABLE, (1, s.vision.n_patch, d), (s.vision.n_patch, d)),
        Weight("camera.weight", "model.camera_embed.weight", TABLE, (len(s.views), d), (len(s.views), d)),
        *norm("fusion.image_norm", fusion + "norm_vision", d),
        *norm("fusion.text_norm", fusion + "norm_text", d),
        Weight("query.weight", decoder + "query_embed.weight", TABLE, (s.horizon, d), (s.horizon, d)),
        *norm("decoder.norm", decoder + "norm", d),
        *linear("action_out", decoder + "action_head", s.d_action, d, bias=True),
    ]
    if s.d_state:
        rows += linear("state_in", "model.state_proj", d, s.d_state, bias=True)
        rows.append(Weight("state_token.weight", "model.state_embed", VECTOR, (1, 1, d), (d,)))
    for i in range(s.n_fusion):
        target, source = "fusion.blk.{}.".format(i), "{}layers.{}.".format(fusion, i)
        rows += _attention(target + "image.", source, "norm_vision_attn", "text_to_vision_attn", s)
        rows += _mlp(target + "image.", source + "norm_vision_ffn", source + "vision_ffn", s)
        rows += _attention(target + "text.", source, "norm_text_attn", "vision_to_text_attn", s)
        rows += _mlp(target + "text.", source + "norm_text_ffn", source + "text_ffn", s)
    for i in range(s.n_decoder):
        target, source = "decoder.blk.{}.".format(i), "{}layers.{}.".format(decoder, i)
        rows += _attention(target, source, "norm_self_attn", "self_attn", s)
        rows += _attention(target + "cross.", source, "norm_cross_attn", "cross_attn", s)
        rows += _mlp(target, source + "norm_ffn", source + "ffn", s)
    return rows


def _attention(target: str, source: str, norm_name: str, attention: str, s: Sizes) -> List[Weight]:
    """An attention with its norm."""
    rows = norm(target + "attn_norm", source + norm_name, s.d_model)
    for part, name in zip(("attn_q", "attn_k", "attn_v", "attn_out"), QKV):
        rows += linear(target + part, "{}{}.{}".format(source, attention, name), s.d_model, s.d_model, bias=True)
    return rows


def _mlp(target: str, norm_name: str, mlp: str, s: Sizes) -> List[Weight]:
    return [
        *norm(target + "ffn_norm", norm_name, s.d_model),
        *linear(target + "ffn_up", mlp + ".linear1", s.d_ff, s.d_model, bias=True),
        *linear(target + "ffn_down", mlp + ".linear2", s.d_model, s.d_ff, bias=True),
    ]


def _vision(s: Sizes) -> List[Weight]:
    v, at = s.vision, VISION + "embeddings."
    patch = (v.d_model, 3, v.patch_size, v.patch_size)
    rows = [
        Weight("vision.patch_embed.weight", at + "patch_embeddings.weight", MATRIX, patch, (v.d_model, 3 * v.patch_size**2)),
        *vector("vision.patch_embed.bias", at + "patch_embeddings.bias", v.d_model),
        Weight("vision.class_token.weight", at + "cls_token", VECTOR, (1, 1, v.d_model), (v.d_model,)),
        *norm("vision.post_norm", VISION + "norm", v.d_model),
    ]
    if s.n_register:
        stored = (1, s.n_register, v.d_model)
        rows.append(Weight("vision.registers.weight", at + "register_tokens", TABLE, stored, stored[1:]))
    for i in range(v.n_layer):
        block = encoder_block("vision.blk.{}.".format(i), "{}model.layer.{}.".format(VISION, i), DINOV3, v.d_model, v.d_ff)
        rows += [row for row in block if not row.target.endswith("attn_k.bias")]
    return rows


def _language(s: Sizes) -> List[Weight]:
    lm, at = s.lm, LANGUAGE + "embeddings."
    token, position = (lm.n_vocab, lm.d_model), (lm.n_position, lm.d_model)
    rows = [
        Weight("lm.token_embd.weight", at + "word_embeddings.weight", TABLE, token, token),
        Weight("lm.position.weight", at + "position_embeddings.weight", TABLE, position, position),
        # An instruction is the first of two sentences.
        Weight("lm.sentence.weight", at + "token_type_embeddings.weight", VECTOR, (s.n_sentence, lm.d_model), (lm.d_model,), pick=(0, 0)),
        *norm("lm.embd_norm", at + "LayerNorm", lm.d_model),
    ]
    for i in range(lm.n_layer):
        rows += encoder_block("lm.blk.{}.".format(i), "{}encoder.layer.{}.".format(LANGUAGE, i), BERT, lm.d_model, lm.d_ff)
    return rows


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

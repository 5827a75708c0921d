# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Keys of the network and names, storage and shapes of every tensor of ACT."""

from __future__ import annotations

from typing import Dict, List, Tuple

from ...bundle import Key
from ...layers import linear, norm, stacked, vector
from ...networks import keys_of
from .. import MATRIX, TABLE, VECTOR, Dropped, Weight
from .config import Sizes

BACKBONE = "model.backbone."
WIDTHS = (64, 128, 256, 512)  # of ResNet's stages
NORM_EPS = 1e-5  # of torch.nn.LayerNorm


def network_keys(s: Sizes) -> List[Key]:
    keys = keys_of(
        {
            "policy": dict(
                d_state=s.d_state + s.d_environment,
                d_robot_state=s.d_state,
                d_environment_state=s.d_environment,
                d_action=s.d_action,
                horizon=s.horizon,
            ),
            "vision": dict(image_width=s.frame[0], image_height=s.frame[1]),
            "transformer": dict(
                d_model=s.d_model,
                n_head=s.n_head,
                d_ff=s.d_ff,
                activation=s.activation,
                norm="before" if s.pre_norm else "after",
                norm_eps=NORM_EPS,
            ),
            "encoder": dict(n_layer=s.n_encoder),
            "decoder": dict(n_layer=s.n_decoder),
            "solver": dict(steps=1, kind="direct", noise="none"),
        }
    )
    return [*keys, Key("vision.n_block", "u32[]", [*s.n_block])]


def weights(s: Sizes) -> List[Weight]:
    d, n_token = s.d_model, _n_token(s)
    rows = [
        *resnet(s.n_block),
        Weight("projector.weight", "model.encoder_img_feat_input_proj.weight", MATRIX, (d, WIDTHS[-1], 1, 1), (d, WIDTHS[-1])),
        *vector("projector.bias", "model.encoder_img_feat_input_proj.bias", d),
        Weight("position.weight", "model.encoder_1d_feature_pos_embed.weight", TABLE, (n_token, d), (n_token, d)),
        # The style variable is zero: its projection is the bias.
        *vector("style.weight", "model.encoder_latent_input_proj.bias", d),
        *linear("state_in", "model.encoder_robot_state_input_proj", d, s.d_state, bias=True),
        Weight("query.weight", "model.decoder_pos_embed.weight", TABLE, (s.horizon, d), (s.horizon, d)),
        *norm("decoder.norm", "model.decoder.norm", d),
        *linear("action_out", "model.action_head", s.d_action, d, bias=True),
    ]
    if s.d_environment:
        rows += linear("environment_in", "model.encoder_env_state_input_proj", d, s.d_environment, bias=True)
    for i in range(s.n_encoder):
        rows += _encoder_layer("encoder.blk.{}.".format(i), "model.encoder.layers.{}.".format(i), s)
    for i in range(s.n_decoder):
        rows += _decoder_layer("decoder.blk.{}.".format(i), "model.decoder.layers.{}.".format(i), s)
    return rows + (norm("encoder.norm", "model.encoder.norm", d) if s.pre_norm else [])


def _n_token(s: Sizes) -> int:
    return 3 if s.d_environment else 2


def resnet(n_block: Tuple[int, ...]) -> List[Weight]:
    rows = convolution("vision.stem", "conv1", "bn1", WIDTHS[0], 3, 7)
    index, d_in = 0, WIDTHS[0]
    for stage, (n, d_out) in enumerate(zip(n_block, WIDTHS)):
        for i in range(n):
            target, source = "vision.blk.{}.".format(index), "layer{}.{}.".format(stage + 1, i)
            rows += convolution(target + "conv1", source + "conv1", source + "bn1", d_out, d_in, 3)
            rows += convolution(target + "conv2", source + "conv2", source + "bn2", d_out, d_out, 3)
            if d_in != d_out:
                rows += convolution(target + "shortcut", source + "downsample.0", source + "downsample.1", d_out, d_in, 1)
            index, d_in = index + 1, d_out
    return rows


def convolution(target: str, source: str, batch_norm: str, d_out: int, d_in: int, size: int) -> List[Weight]:
    """With the frozen batch norm behind it, which becomes part of matrix and bias."""
    folded = dict(batch_norm=BACKBONE + batch_norm)
    stored, shape = (d_out, d_in, size, size), (d_out, size * size * d_in)
    return [
        Weight(target + ".weight", BACKBONE + source + ".weight", MATRIX, stored, shape, **folded),
        Weight(target + ".bias", "{}{}.bias".format(BACKBONE, batch_norm), VECTOR, (d_out,), (d_out,), **folded),
    ]


def _attention(target: str, source: str, d: int) -> List[Weight]:
    return [*stacked(target, source + "in_proj_", d), *linear(target + "attn_out", source + "out_proj", d, d, bias=True)]


def _mlp(target: str, source: str, s: Sizes) -> List[Weight]:
    return [
        *linear(target + "ffn_up", source + "linear1", s.d_ff, s.d_model, bias=True),
        *linear(target + "ffn_down", source + "linear2", s.d_model, s.d_ff, bias=True),
    ]


def _encoder_layer(target: str, source: str, s: Sizes) -> List[Weight]:
    return [
        *norm(target + "attn_norm", source + "norm1", s.d_model),
        *_attention(target, source + "self_attn.", s.d_model),
        *norm(target + "ffn_norm", source + "norm2", s.d_model),
        *_mlp(target, source, s),
    ]


def _decoder_layer(target: str, source: str, s: Sizes) -> List[Weight]:
    return [
        *norm(target + "attn_norm", source + "norm1", s.d_model),
        *_attention(target, source + "self_attn.", s.d_model),
        *norm(target + "cross.attn_norm", source + "norm2", s.d_model),
        *_attention(target + "cross.", source + "multihead_attn.", s.d_model),
        *norm(target + "ffn_norm", source + "norm3", s.d_model),
        *_mlp(target, source, s),
    ]


def dropped(s: Sizes) -> List[Dropped]:
    """What training alone reads."""
    style = "the style variable is zero outside of training"
    rows = [Dropped("model.encoder_latent_input_proj.weight", (s.d_model, s.d_latent), style)]
    if not s.has_vae:
        return rows
    d, at = s.d_model, "model.vae_encoder"
    shapes = {
        at + "_cls_embed.weight": (1, d),
        at + "_robot_state_input_proj.weight": (d, s.d_state),
        at + "_robot_state_input_proj.bias": (d,),
        at + "_action_input_proj.weight": (d, s.d_action),
        at + "_action_input_proj.bias": (d,),
        at + "_latent_output_proj.weight": (2 * s.d_latent, d),
        at + "_latent_output_proj.bias": (2 * s.d_latent,),
        at + "_pos_enc": (1, 2 + s.horizon, d),
    }
    layers = [row for i in range(s.n_vae) for row in _encoder_layer("", "{}.layers.{}.".format(at, i), s)]
    shapes.update({row.source: row.stored for row in layers + (norm("", at + ".norm", d) if s.pre_norm else [])})
    return rows + [Dropped(source, shape, "the encoder of the style variable is for training") for source, shape in shapes.items()]


def hints(s: Sizes) -> Dict[str, str]:
    return {
        "model.encoder.layers.": "n_encoder_layers is {}".format(s.n_encoder),
        "model.decoder.layers.": "n_decoder_layers is {}".format(s.n_decoder),
        "model.backbone.fc.": "the policy ends before the classifier",
        "model.vae_encoder": "use_vae is {}".format(str(s.has_vae).lower()),
    }

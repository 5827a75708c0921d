# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Keys of the network and names of every tensor of ACT."""

from __future__ import annotations

from typing import Dict, List, Mapping, NamedTuple, Sequence

from ...bundle import Key
from ...layers import Names, Rows, blocks, linear, norm, table, vector
from ...networks import NORM_EPS, keys_of, pick
from .. import MATRIX, VECTOR, Dropped, Weight
from .config import Sizes

BACKBONE = "model.backbone."
WIDTHS = (64, 128, 256, 512)  # widths of ResNet's stages
VAE = "the encoder of the style variable is for training"
ENCODER = Names("self_attn.in_proj_ self_attn.out_proj", "linear1 linear2", "norm1 norm2")
DECODER = ENCODER._replace(norms="norm1 norm2 norm3", cross="multihead_attn.in_proj_ multihead_attn.out_proj")


def network_keys(s: Sizes) -> List[Key]:
    states = dict(d_state=s.d_state + s.d_environment, d_robot_state=s.d_state, d_environment_state=s.d_environment)
    order = dict(activation=s.activation, norm="before" if s.pre_norm else "after", norm_eps=NORM_EPS)
    return keys_of(
        {
            "policy": dict(states, **pick(s, "d_action horizon")),
            "vision": dict(image_width=s.frame[0], image_height=s.frame[1], n_block=s.n_block, **of_views(s)),
            "transformer": dict(pick(s, "d_model n_head d_ff"), **order),
            "encoder": dict(n_layer=s.n_encoder),
            "decoder": dict(n_layer=s.n_decoder),
            "solver": dict(steps=1, kind="direct", noise="none"),
        }
    )


def of_views(s: Sizes) -> Dict[str, List[int]]:
    """The key with the sizes of the views' frames, if they differ."""
    return {"view_sizes": [side for size in s.frames for side in size]} if len(set(s.frames)) > 1 else {}


def weights(s: Sizes) -> Rows:
    d = s.d_model
    rows = [
        *resnet(s.n_block),
        Weight("projector.weight", "model.encoder_img_feat_input_proj.weight", MATRIX, (d, WIDTHS[-1], 1, 1), (d, WIDTHS[-1])),
        *vector("projector.bias", "model.encoder_img_feat_input_proj.bias", d),
        *table("position", "model.encoder_1d_feature_pos_embed.weight", 3 if s.d_environment else 2, d),
        # The style variable is zero, so its projection equals the bias.
        *vector("style.weight", "model.encoder_latent_input_proj.bias", d),
        *linear("state_in", "model.encoder_robot_state_input_proj", d, s.d_state),
        *table("query", "model.decoder_pos_embed.weight", s.horizon, d),
        *norm("decoder.norm", "model.decoder.norm", d),
        *linear("action_out", "model.action_head", s.d_action, d),
    ]
    if s.d_environment:
        rows += linear("environment_in", "model.encoder_env_state_input_proj", d, s.d_environment)
    rows += blocks("encoder.", "model.encoder.layers.{}.", ENCODER, s.n_encoder, d, s.d_ff)
    rows += blocks("decoder.", "model.decoder.layers.{}.", DECODER, s.n_decoder, d, s.d_ff)
    return rows + (norm("encoder.norm", "model.encoder.norm", d) if s.pre_norm else [])


class Named(NamedTuple):
    """A convolution of a ResNet. target: the bundle's name; source, norm: torchvision's names of the convolution and of the norm after it;
    d_out, d_in: widths; size: side of the kernel."""

    target: str
    source: str
    norm: str
    d_out: int
    d_in: int
    size: int


def resnet_convolutions(n_block: Sequence[int], renamed: Mapping[str, str] = {}) -> List[Named]:
    """The convolutions of a ResNet. `renamed`: torchvision's module names -> the checkpoint's."""
    found = [Named("stem", "conv1", "bn1", WIDTHS[0], 3, 7)]
    d_in = WIDTHS[0]
    for stage, (n, d_out) in enumerate(zip(n_block, WIDTHS)):
        for i in range(n):
            target, source = "blk.{}.".format(sum(n_block[:stage]) + i), "layer{}.{}.".format(stage + 1, i)
            found.append(Named(target + "conv1", source + "conv1", source + "bn1", d_out, d_in, 3))
            found.append(Named(target + "conv2", source + "conv2", source + "bn2", d_out, d_out, 3))
            if d_in != d_out:
                found.append(Named(target + "shortcut", source + "downsample.0", source + "downsample.1", d_out, d_in, 1))
            d_in = d_out

    def their(name: str) -> str:
        first, dot, rest = name.partition(".")
        return renamed.get(first, first) + dot + rest

    return [row._replace(source=their(row.source), norm=their(row.norm)) for row in found]


def resnet(n_block: Sequence[int]) -> Rows:
    rows: Rows = []
    for row in resnet_convolutions(n_block):
        rows += convolution("vision." + row.target, row.source, row.norm, row.d_out, row.d_in, row.size)
    return rows


def convolution(target: str, source: str, batch_norm: str, d_out: int, d_in: int, size: int) -> Rows:
    """A convolution with the frozen batch norm after it, which is folded into matrix and bias."""
    folded = dict(batch_norm=BACKBONE + batch_norm)
    stored, shape = (d_out, d_in, size, size), (d_out, size * size * d_in)
    return [
        Weight(target + ".weight", BACKBONE + source + ".weight", MATRIX, stored, shape, **folded),
        Weight(target + ".bias", "{}{}.bias".format(BACKBONE, batch_norm), VECTOR, (d_out,), (d_out,), **folded),
    ]


def dropped(s: Sizes) -> List[Dropped]:
    """Tensors that only training reads."""
    style = "the style variable is zero outside of training"
    rows = [Dropped("model.encoder_latent_input_proj.weight", (s.d_model, s.d_latent), style)]
    if not s.has_vae:
        return rows
    d, at = s.d_model, "model.vae_encoder"
    rows += [Dropped(name, shape, VAE) for name, shape in ((at + "_cls_embed.weight", (1, d)), (at + "_pos_enc", (1, 2 + s.horizon, d)))]
    trained = [
        *linear("", at + "_robot_state_input_proj", d, s.d_state),
        *linear("", at + "_action_input_proj", d, s.d_action),
        *linear("", at + "_latent_output_proj", 2 * s.d_latent, d),
        *blocks("", at + ".layers.{}.", ENCODER, s.n_vae, d, s.d_ff),
        *(norm("", at + ".norm", d) if s.pre_norm else []),
    ]
    return rows + [Dropped(row.source, row.stored, VAE) for row in trained]


def hints(s: Sizes) -> Dict[str, str]:
    return {
        "model.encoder.layers.": "n_encoder_layers is {}".format(s.n_encoder),
        "model.decoder.layers.": "n_decoder_layers is {}".format(s.n_decoder),
        "model.backbone.fc.": "the policy ends before the classifier",
        "model.vae_encoder": "use_vae is {}".format(str(s.has_vae).lower()),
    }

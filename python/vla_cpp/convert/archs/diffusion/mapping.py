# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Keys of the network and names of every tensor of a Diffusion Policy."""

from __future__ import annotations

from typing import Dict, List

from ...bundle import Key
from ...layers import Rows, linear, norm, vector
from ...networks import NORM_EPS, keys_of, pick
from .. import MATRIX, VECTOR, Dropped, Weight
from ..act.mapping import WIDTHS, resnet_convolutions
from .config import Sizes

UNET = "diffusion.unet."
GROUP = 16  # features per group of the group norms that replace batch norms


def network_keys(s: Sizes) -> List[Key]:
    states = dict(d_state=s.n_moment * (s.d_state + s.d_environment), d_robot_state=s.d_state, d_environment_state=s.d_environment)
    groups = dict(group_width=GROUP, norm_eps=NORM_EPS) if s.group_norm else {}
    vision = dict(image_width=s.image[0], image_height=s.image[1], **pick(s, "n_block n_keypoint"), **groups)
    encoders = dict(encoders="separate" if s.separate else "shared")
    return keys_of(
        {
            "policy": dict(states, n_camera=len(s.cameras), **(encoders if s.cameras else {}), **pick(s, "n_moment d_action horizon")),
            "vision": vision if s.cameras else {},
            "unet": dict(norm_eps=NORM_EPS, film="scale_shift" if s.scales else "shift", **pick(s, "widths kernel_size n_group d_time")),
            "solver": dict(kind=s.scheduler, steps=s.n_step, noise="normal", **pick(s, "n_train_step beta_schedule beta_start beta_end predicts clip")),
        }
    )


def weights(s: Sizes) -> Rows:
    rows = [row for target, source in s.encoders for row in encoder(s, target, source)]
    rows += linear("time_in", UNET + "diffusion_step_encoder.1", 4 * s.d_time, s.d_time)
    rows += linear("time_out", UNET + "diffusion_step_encoder.3", s.d_time, 4 * s.d_time)
    return rows + unet(s)


def encoder(s: Sizes, target: str, source: str) -> Rows:
    rows, k = [], s.n_keypoint
    for name, at, batch_norm, d_out, d_in, size in resnet_convolutions(s.n_block, SEQUENTIAL):
        rows += convolution(s, target + name, source + "backbone." + at, source + "backbone." + batch_norm, d_out, d_in, size)
    return rows + [
        Weight(target + "keypoints.weight", source + "pool.nets.weight", MATRIX, (k, WIDTHS[-1], 1, 1), (k, WIDTHS[-1])),
        *vector(target + "keypoints.bias", source + "pool.nets.bias", k),
        *vector(target + "keypoints.places", source + "pool.pos_grid", 2 * s.n_cell, (s.n_cell, 2)),
        *linear(target + "out", source + "out", 2 * k, 2 * k),
    ]


# torchvision's modules -> their index: the reference keeps all but the last two modules of a ResNet in a Sequential.
SEQUENTIAL = {"conv1": "0", "bn1": "1", "layer1": "4", "layer2": "5", "layer3": "6", "layer4": "7"}
NORMS = {"stem": "stem_norm", "conv1": "norm1", "conv2": "norm2", "shortcut": "shortcut_norm"}


def convolution(s: Sizes, target: str, source: str, behind: str, d_out: int, d_in: int, size: int) -> Rows:
    """A convolution and the norm after it: a frozen batch norm is folded into matrix and bias; a group norm has its own tensors."""
    stored, shape = (d_out, d_in, size, size), (d_out, size * size * d_in)
    if not s.group_norm:
        return [
            Weight(target + ".weight", source + ".weight", MATRIX, stored, shape, batch_norm=behind),
            Weight(target + ".bias", behind + ".bias", VECTOR, (d_out,), (d_out,), batch_norm=behind),
        ]
    at, dot, name = target.rpartition(".")
    matrix = Weight(target + ".weight", source + ".weight", MATRIX, stored, shape, axes=(0, 2, 3, 1))
    return [matrix, *norm(at + dot + NORMS[name], behind, d_out)]


def unet(s: Sizes) -> Rows:
    """Blocks in order of execution: two per level downwards, two at the bottom, two per level upwards."""
    n, widths = len(s.widths), (s.d_action, *s.widths)
    blocks = [("down_modules.{}.{{}}".format(i), widths[i], widths[i + 1]) for i in range(n)]
    blocks += [("mid_modules.{}", widths[n], widths[n])]
    blocks += [("up_modules.{}.{{}}".format(i), 2 * widths[n - i], widths[n - i - 1]) for i in range(n - 1)]
    rows: Rows = []
    for i, (at, d_in, d_out) in enumerate(blocks):
        for half, d in enumerate((d_in, d_out)):
            rows += block(s, "unet.blk.{}.".format(2 * i + half), UNET + at.format(half) + ".", d, d_out)
    for i in range(n - 1):
        rows += token_convolution("unet.down.{}".format(i), UNET + "down_modules.{}.2".format(i), widths[i + 1], widths[i + 1], 3)
        rows += doubling("unet.up.{}.".format(i), UNET + "up_modules.{}.2".format(i), widths[n - i - 1])
    return [
        *rows,
        *token_convolution("unet.out", UNET + "final_conv.0.block.0", widths[1], widths[1], s.kernel_size),
        *norm("unet.out_norm", UNET + "final_conv.0.block.1", widths[1]),
        Weight("unet.action_out.weight", UNET + "final_conv.1.weight", MATRIX, (s.d_action, widths[1], 1), (s.d_action, widths[1])),
        *vector("unet.action_out.bias", UNET + "final_conv.1.bias", s.d_action),
    ]


def block(s: Sizes, target: str, source: str, d_in: int, d_out: int) -> Rows:
    rows, film = [], source + "cond_encoder.1"
    for i, d in ((1, d_in), (2, d_out)):
        rows += token_convolution("{}conv{}".format(target, i), "{}conv{}.block.0".format(source, i), d_out, d, s.kernel_size)
        rows += norm("{}norm{}".format(target, i), "{}conv{}.block.1".format(source, i), d_out)
    # The condition is the embedding of the time, followed by the observation.
    d_film, d_all = (2 if s.scales else 1) * d_out, s.d_time + s.d_observation
    for name, columns in (("film_time", range(s.d_time)), ("film_observation", range(s.d_time, d_all))):
        shape = (d_film, len(columns))
        rows.append(Weight("{}{}.weight".format(target, name), film + ".weight", MATRIX, (d_film, d_all), shape, pick=(1, columns)))
    rows += vector(target + "film_time.bias", film + ".bias", d_film)
    if d_in != d_out:
        shortcut = source + "residual_conv"
        rows.append(Weight(target + "shortcut.weight", shortcut + ".weight", MATRIX, (d_out, d_in, 1), (d_out, d_in)))
        rows += vector(target + "shortcut.bias", shortcut + ".bias", d_out)
    return rows


def token_convolution(target: str, source: str, d_out: int, d_in: int, size: int) -> Rows:
    matrix = Weight(target + ".weight", source + ".weight", MATRIX, (d_out, d_in, size), (d_out, size * d_in), axes=(0, 2, 1))
    return [matrix, *vector(target + ".bias", source + ".bias", d_out)]


def doubling(target: str, source: str, d: int) -> Rows:
    """A transposed convolution with kernel size 4, stored as (in, out, kernel position). It doubles the number of tokens: an output at an even
    position is the previous input times kernel position 3 plus its own input times position 1; at an odd position it is its own input times
    position 2 plus the next input times position 0."""
    rows: Rows = []
    for name, places in (("even", (3, 1)), ("odd", (2, 0))):
        rows.append(Weight(target + name + ".weight", source + ".weight", MATRIX, (d, d, 4), (d, 2 * d), pick=(2, places), axes=(1, 2, 0)))
        rows += vector(target + name + ".bias", source + ".bias", d)
    return rows


def dropped(s: Sizes) -> List[Dropped]:
    """Counters in batch norms, which only training reads."""
    if s.group_norm:
        return []
    reason = "how many batches a norm has seen matters in training alone"
    norms = [behind for _, _, behind, *_ in resnet_convolutions(s.n_block, SEQUENTIAL)]
    return [Dropped("{}backbone.{}.num_batches_tracked".format(source, at), (), reason) for _, source in s.encoders for at in norms]


def hints(s: Sizes) -> Dict[str, str]:
    return {
        "diffusion.rgb_encoder.": "use_separate_rgb_encoder_per_camera is {}, use_group_norm is {}".format(
            str(s.separate).lower(), str(s.group_norm).lower()
        ),
        UNET: "down_dims are {}".format(list(s.widths)),
    }

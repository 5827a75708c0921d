# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Sizes of an ACT policy from its config.json, with refusals of everything that the runtime does not support.

An absent key has the default of the reference's own class, listed here with the key.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Sequence, Tuple

from ...checkpoint import Checkpoint
from ...errors import Problems
from ...lerobot import action_width, check_keys, check_widths, no_position_rule, state_width, vector_dim
from ...recipe import STATE
from ...section import Section
from .. import Options

ENVIRONMENT = "observation.environment_state"
# ACTConfig keys with effect on numbers, with the class's defaults.
POLICY = {
    "chunk_size": 100,
    "n_action_steps": 100,
    "vision_backbone": "resnet18",
    "pre_norm": False,
    "dim_model": 512,
    "n_heads": 8,
    "dim_feedforward": 3200,
    "feedforward_activation": "relu",
    "n_encoder_layers": 4,
    "n_decoder_layers": 1,
    "use_vae": True,
    "latent_dim": 32,
    "n_vae_encoder_layers": 4,
    "temporal_ensemble_coeff": None,
    "normalization_mapping": {"VISUAL": "MEAN_STD", "STATE": "MEAN_STD", "ACTION": "MEAN_STD"},
}
FIXED = {"replace_final_stride_with_dilation": (False, "torchvision has no ResNet-18 or -34 with dilation either")}
# Keys without effect on the numbers of an action chunk, beside those of every LeRobot policy.
IGNORED = set("pretrained_backbone_weights dropout kl_weight optimizer_lr_backbone".split())
# torchvision models/resnet.py: number of blocks per stage. Other ResNets have a different kind of block.
BACKBONES = {"resnet18": (2, 2, 2, 2), "resnet34": (3, 4, 6, 3)}
ACTIVATIONS = {"relu": "relu", "gelu": "gelu_erf"}
MAX_LAYERS, MAX_SIDE, MAX_VIEWS = 512, 8192, 64


@dataclass
class Sizes:
    views: Sequence[str]
    frame: Tuple[int, int]  # width, height of the images: the largest width and height over the views' frames
    frames: Sequence[Tuple[int, int]]  # width, height of each view's frames
    d_state: int
    d_environment: int  # 0: there is none
    d_action: int
    horizon: int
    n_block: Sequence[int]
    d_model: int
    n_head: int
    d_ff: int
    activation: str
    pre_norm: bool
    n_encoder: int
    n_decoder: int
    has_vae: bool  # the checkpoint has a VAE encoder, which only training uses
    d_latent: int
    n_vae: int


def read_sizes(checkpoint: Checkpoint, options: Options, problems: Problems) -> Sizes:
    policy = Section("config.json", checkpoint.config, POLICY, problems)
    no_position_rule(policy, options, problems)
    check_keys(policy, "ACTConfig", set(POLICY) | IGNORED, FIXED)
    check_widths(policy, {})
    _check_words(policy)
    _note_ensemble(policy, checkpoint)
    views, frames = cameras_of(policy)
    if not views:
        policy.bad("input_features", "a VISUAL feature or several", "none", "an ACT without cameras is not supported", unsupported=True)
    features = policy.get("input_features")
    has_environment = isinstance(features, dict) and ENVIRONMENT in features
    s = Sizes(
        views=views,
        frame=(max(width for width, _ in frames), max(height for _, height in frames)),
        frames=frames,
        d_state=state_width(policy, checkpoint, options, padded=False),
        d_environment=vector_dim(policy, "input_features", ENVIRONMENT, "ENV") if has_environment else 0,
        d_action=action_width(policy, checkpoint, options),
        horizon=policy.count("chunk_size", maximum=4096),
        n_block=BACKBONES.get(policy.get("vision_backbone"), (1, 1, 1, 1)),
        d_model=policy.count("dim_model"),
        n_head=policy.count("n_heads"),
        d_ff=policy.count("dim_feedforward"),
        activation=ACTIVATIONS.get(policy.get("feedforward_activation"), "relu"),
        pre_norm=policy.get("pre_norm") is True,
        n_encoder=policy.count("n_encoder_layers", maximum=MAX_LAYERS),
        n_decoder=policy.count("n_decoder_layers", maximum=MAX_LAYERS),
        has_vae=policy.get("use_vae") is True,
        d_latent=policy.count("latent_dim"),
        n_vae=policy.count("n_vae_encoder_layers", 0, MAX_LAYERS),
    )
    if s.d_model % s.n_head:
        policy.bad("n_heads", "a divisor of dim_model {}".format(s.d_model))
    if s.d_model % 4:
        policy.bad("dim_model", "a multiple of 4, for positions of cells in two directions")
    return s


def _check_words(policy: Section) -> None:
    backbone, activation = policy.get("vision_backbone"), policy.get("feedforward_activation")
    if backbone not in BACKBONES:
        hint = "their blocks are three convolutions, which the runtime does not have" if str(backbone).startswith("resnet") else ""
        policy.bad("vision_backbone", " or ".join(BACKBONES), hint=hint, unsupported=True)
    if activation not in ACTIVATIONS:
        hint = "the reference's own layers cannot run it: it halves the width" if activation == "glu" else ""
        policy.bad("feedforward_activation", " or ".join(ACTIVATIONS), hint=hint, unsupported=True)
    for key in ("pre_norm", "use_vae"):
        if not isinstance(policy.get(key), bool):
            policy.bad(key, "true or false")
    if not isinstance(policy.get("normalization_mapping"), dict):
        policy.bad("normalization_mapping", "the modes of VISUAL, STATE and ACTION")
    policy.values.setdefault("normalization_mapping", POLICY["normalization_mapping"])  # readers of the older layout use it


def _note_ensemble(policy: Section, checkpoint: Checkpoint) -> None:
    """Notes temporal ensembling: a bundle only produces chunks, and the client blends them."""
    coefficient = policy.get("temporal_ensemble_coeff")
    if coefficient is None:
        return
    if isinstance(coefficient, bool) or not isinstance(coefficient, (int, float)):
        policy.bad("temporal_ensemble_coeff", "a number, or null")
    elif coefficient < 0:
        hint = "newer chunks would weigh more, which the control loop does not do; set it to null and choose a blend of the client's"
        policy.bad("temporal_ensemble_coeff", "0 or more, or null", hint=hint, unsupported=True)
    else:
        checkpoint.notes.append(
            "temporal_ensemble_coeff {0}: chunks are as without it; the client ensembles them: ChunkLoop(replan_every=1, "
            'blend="ensemble", decay={0})'.format(coefficient)
        )


def cameras_of(policy: Section) -> Tuple[Sequence[str], Sequence[Tuple[int, int]]]:
    """Cameras in order, and (width, height) of their frames. Refuses features that the reference does not read, since they may be misspelt."""
    features = policy.get("input_features")
    views, sizes = [], []
    for name, feature in (features if isinstance(features, dict) else {}).items():
        kind, shape = (feature.get("type"), feature.get("shape")) if isinstance(feature, dict) else (None, None)
        if kind == "VISUAL":
            views.append(name)
            whole = isinstance(shape, list) and len(shape) == 3 and all(isinstance(n, int) and 0 < n <= MAX_SIDE for n in shape)
            if whole and shape[0] == 3:
                sizes.append((shape[2], shape[1]))
            else:
                policy.bad("input_features." + name, "a frame of shape [3, height, width]", str(shape))
        elif name not in (STATE, ENVIRONMENT):
            policy.bad("input_features." + name, "cameras, {} and {}".format(STATE, ENVIRONMENT), str(kind), unsupported=True)
    if len(views) > MAX_VIEWS:
        policy.bad("input_features", "at most {} cameras".format(MAX_VIEWS), str(len(views)), unsupported=True)
    return views, sizes or [(1, 1)]

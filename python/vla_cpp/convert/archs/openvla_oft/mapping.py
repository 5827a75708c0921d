# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Sizes of OpenVLA-OFT and the names of its tensors: OpenVLA's, and those of the files beside them.

Reference: moojink/openvla-oft prismatic/models (action_heads.py, projectors.py, film_vit_wrapper.py).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Dict, List, Tuple

from ...adapters import is_adapter_name, merge, parse
from ...bundle import Key
from ...checkpoint import Checkpoint, Tensors
from ...errors import Problems
from ...layers import Rows, linear
from ...networks import NORM_EPS, decoder, keys_of, pick
from ...safetensors_file import Entry
from .. import Dropped, oft
from ..openvla import mapping as openvla
from ..openvla.mapping import DINO, HEAD, LM, SIGLIP

NOISY, VISION = "noisy_action_projector.", "vision_backbone."  # prefixes of tensor names in the authors' files
REGRESSION, DIFFUSION = oft.HEAD + "model.", oft.HEAD + "noise_predictor.mlp_resnet."
STOP_TOKEN = 2  # a literal of the reference, which ignores the stop token in config.json
MAX_ALPHA = 16  # LoRA's alpha is the rank, at most this
# DDIMScheduler's settings: its defaults and a literal of the action head.
SCHEDULE = dict(beta_schedule="squaredcos_cap_v2", beta_start=0.0001, beta_end=0.02, predicts="noise", clip=1.0)


@dataclass
class Sizes(openvla.Sizes):
    d_state: int = 0
    horizon: int = 0
    has_film: bool = False
    n_train_step: int = 0  # training steps of a diffusion head; 0: another head
    n_step: int = 1


def read_sizes(checkpoint: Checkpoint, problems: Problems) -> Sizes:
    """The sizes that files state."""
    s = Sizes(**vars(openvla.read_sizes(checkpoint, problems)))
    s.stop_token = STOP_TOKEN
    s.has_film = DINO + "blocks.0.scale.weight" in checkpoint.tensors
    s.d_action = oft.dim(checkpoint, head_of(checkpoint) + "fc2.weight", 0, problems)
    if any(name.startswith(oft.PROPRIO) for name in checkpoint.tensors):
        s.d_state = oft.dim(checkpoint, oft.PROPRIO + "fc1.weight", 1, problems)
    return s


def head_of(checkpoint: Checkpoint) -> str:
    return DIFFUSION if any(name.startswith(DIFFUSION) for name in checkpoint.tensors) else REGRESSION


def network_keys(s: Sizes) -> List[Key]:
    solver: Dict[str, object] = dict(kind="direct", steps=1, noise="none")
    if s.n_train_step:
        solver = dict(kind="ddim", steps=s.n_step, noise="normal", n_train_step=s.n_train_step, **SCHEDULE)
    return keys_of(
        {
            "policy": {**pick(s, "d_state d_action horizon stop_token"), "film": "scale_shift" if s.has_film else "none"},
            **openvla.module_keys(s),
            "head": dict(n_layer=oft.N_HEAD_LAYER, norm_eps=NORM_EPS),
            "solver": solver,
        }
    )


def weights(s: Sizes, pixels: Tuple[Dict[str, tuple], Dict[str, tuple]]) -> Rows:
    """Rows of all tensors. `pixels`: mean and std of each tower's pixels."""
    d = s.lm.d_model
    return [
        *openvla.image_weights(s, pixels),
        *(_film(s) if s.has_film else []),
        *decoder(s.lm, LM),
        *(oft.projector("state", oft.PROPRIO, d, s.d_state) if s.d_state else []),
        *(oft.projector("noise", NOISY, d, 1) if s.n_train_step else []),
        *oft.head(DIFFUSION if s.n_train_step else REGRESSION, d, s.d_action),
    ]


def _film(s: Sizes) -> Rows:
    return [
        row
        for target, source, tower in (("dino", DINO, s.dino), ("siglip", SIGLIP, s.siglip))
        for i in range(tower.n_layer)
        for row in _film_of("{}.blk.{}.".format(target, i), "{}blocks.{}.".format(source, i), tower.d_model, s.lm.d_model)
    ]


def _film_of(target: str, source: str, d: int, d_text: int) -> Rows:
    """The layers of FiLM. The factor of a feature is 1 + scale."""
    rows = linear(target + "film_scale", source + "scale", d, d_text) + linear(target + "film_shift", source + "shift", d, d_text)
    rows[1] = rows[1]._replace(plus_one=True)
    return oft.in_bf16(rows)


def dropped(s: Sizes) -> List[Dropped]:
    rows = [*openvla.dropped(s), Dropped(HEAD + ".weight", (s.lm.n_vocab, s.lm.d_model), "no action depends on the language head")]
    for source, tower in ((DINO, s.dino), (SIGLIP, s.siglip)) if s.has_film else ():
        last = _film_of("", "{}blocks.{}.".format(source, tower.n_layer), tower.d_model, s.lm.d_model)
        rows += [Dropped(row.source, row.stored, "features are read in front of it") for row in last]
    return rows


def put_film(tensors: Tensors, problems: Problems) -> None:
    """If there is a file of towers with FiLM, its towers replace those beside the language model, which were saved without FiLM. The file has
    unmerged LoRA, which is merged here; the authors' evaluation rounds everything in the file to bfloat16."""
    stored, own = tensors[0], VISION + VISION
    found = {name: stored.pop(name) for name in list(stored) if name.startswith(own)}
    if not found:
        return
    for name in [name for name in stored if name.startswith(VISION)]:
        del stored[name]
    adapter: Dict[str, Entry] = {}
    for name, entry in found.items():
        plain = re.sub(r"(\.blocks\.\d+)\.block\.", r"\1.", name[len(VISION) :]).replace(".base_layer.", ".")
        (adapter if is_adapter_name(plain) else stored)[plain] = entry._replace(name=plain)
    if adapter:
        rank = next((entry.shape[0] for name, entry in adapter.items() if ".lora_A." in name and entry.shape), 0)
        config = {"peft_type": "LORA", "r": rank, "lora_alpha": min(rank, MAX_ALPHA)}
        merge(stored, parse(config, adapter, problems, in_bf16=True), [], problems)

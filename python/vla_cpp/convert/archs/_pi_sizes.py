# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Sizes of a π0 or π0.5 policy. Its configuration knows two sizes by name; a `dims.json` beside it states others."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Dict

from ..checkpoint import Checkpoint
from ..errors import Problems
from ..files import member, read_json
from ..section import Section

DIMS_FILE = "dims.json"
# lerobot modeling_pi0.py (get_gemma_config) and openpi models/gemma.py (get_config).
VARIANTS = {
    "gemma_2b": dict(width=2048, depth=18, mlp_dim=16384, num_heads=8, num_kv_heads=1, head_dim=256),
    "gemma_300m": dict(width=1024, depth=18, mlp_dim=4096, num_heads=8, num_kv_heads=1, head_dim=256),
}
# SigLIP-So400m/14 as PaliGemma's config and modeling_pi0.py (PaliGemmaWithExpertModel) have it.
VISION = dict(
    hidden_size=1152,
    num_hidden_layers=27,
    num_attention_heads=16,
    intermediate_size=4304,
    patch_size=14,
    image_size=0,  # as the configuration says, which for openpi is a literal
)
N_VOCAB = 257152
EPS, ROPE_BASE = 1e-6, 10000.0  # of both Gemma configs and of the tower, which state no others


@dataclass
class Sizes:
    """Widths and counts; the names are those of the bundle's keys."""

    image_size: int = 0
    patch_size: int = 0
    d_vision: int = 0
    n_vision_layer: int = 0
    n_vision_head: int = 0
    d_vision_ff: int = 0
    d_model: int = 0
    n_layer: int = 0
    n_head: int = 0
    n_head_kv: int = 0
    d_head: int = 0
    d_ff: int = 0
    n_vocab: int = 0
    d_expert: int = 0
    d_expert_ff: int = 0
    state_dim: int = 0  # of the robot
    action_dim: int = 0
    d_state: int = 0  # of the network
    d_action: int = 0
    horizon: int = 0
    n_step: int = 0
    min_period: float = 0.0
    max_period: float = 0.0
    solver: str = "euler"

    @property
    def n_position(self) -> int:
        return (self.image_size // self.patch_size) ** 2


def read_towers(policy: Section, checkpoint: Checkpoint, problems: Problems) -> Sizes:
    """The sizes of the three towers; `policy` names the variants of two."""
    dims = _dims(checkpoint, problems)
    lm, expert = (
        _gemma(policy, key, dims, problems) for key in ("paligemma_variant", "action_expert_variant")
    )
    vision = Section(DIMS_FILE + ": vision", member(dims, "vision", dict, DIMS_FILE), VISION, problems)
    _known(vision)
    for key in ("depth", "num_heads", "num_kv_heads", "head_dim"):
        if lm.count(key) != expert.count(key):
            expert.bad(key, "that of the language model, {}: the layers attend together".format(lm.count(key)))
    if lm.count("num_heads") % lm.count("num_kv_heads"):
        lm.bad("num_kv_heads", "a divisor of num_heads {}".format(lm.count("num_heads")))
    if lm.count("head_dim") % 2:
        lm.bad("head_dim", "an even number, for the rotary embedding")
    if expert.count("width") % 2:
        expert.bad("width", "an even number, for the time embedding")
    if vision.count("hidden_size") % vision.count("num_attention_heads"):
        vision.bad("num_attention_heads", "a divisor of hidden_size {}".format(vision.count("hidden_size")))
    top = Section(DIMS_FILE, dims, {"vocab_size": N_VOCAB}, problems)
    return Sizes(
        image_size=vision.count("image_size", 0) if "image_size" in vision.values else 0,
        patch_size=vision.count("patch_size"),
        d_vision=vision.count("hidden_size"),
        n_vision_layer=vision.count("num_hidden_layers", most=1024),
        n_vision_head=vision.count("num_attention_heads"),
        d_vision_ff=vision.count("intermediate_size"),
        d_model=lm.count("width"),
        n_layer=lm.count("depth", most=1024),
        n_head=lm.count("num_heads"),
        n_head_kv=lm.count("num_kv_heads"),
        d_head=lm.count("head_dim"),
        d_ff=lm.count("mlp_dim"),
        n_vocab=top.count("vocab_size"),
        d_expert=expert.count("width"),
        d_expert_ff=expert.count("mlp_dim"),
    )


def check_image(policy: Section, key: str, sizes: Sizes, resolution) -> None:
    """Sets the size of the pictures, which the reference wants square."""
    square = isinstance(resolution, list) and len(resolution) == 2 and resolution[0] == resolution[1]
    side = resolution[0] if square else 0
    if type(side) is not int or not sizes.patch_size <= side <= 8192:
        policy.bad(key, "two equal sides from patch_size {} to 8192".format(sizes.patch_size), repr(resolution))
        side = sizes.patch_size
    if sizes.image_size not in (0, side):
        policy.bad(key, "the image_size of {}, {}".format(DIMS_FILE, sizes.image_size), repr(resolution))
    sizes.image_size = side


def _dims(checkpoint: Checkpoint, problems: Problems) -> dict:
    if not os.path.exists(checkpoint.path(DIMS_FILE)):
        return {}
    dims = read_json(checkpoint.path(DIMS_FILE))
    for key in sorted(set(dims) - {"size", "vision", "vocab_size", *VARIANTS}):
        problems.unsupported("{}: {}".format(DIMS_FILE, key), "vision, vocab_size or a Gemma variant", repr(dims[key])[:80])
    checkpoint.notes.append("sizes: from {} where it states them".format(DIMS_FILE))
    return dims


def _gemma(policy: Section, key: str, dims: dict, problems: Problems) -> Section:
    variant = policy.get(key)
    if not isinstance(variant, str) or variant not in VARIANTS:
        policy.bad(key, " or ".join(VARIANTS), unsupported=True, hint="merge adapters into the policy and save it again")
        variant = "gemma_300m"
    section = Section(
        "{}: {}".format(DIMS_FILE, variant), member(dims, variant, dict, DIMS_FILE), VARIANTS[variant], problems
    )
    _known(section)
    return section


def _known(section: Section) -> None:
    for key in sorted(set(section.values) - set(section.defaults)):
        section.bad(key, "one of " + ", ".join(section.defaults), unsupported=True)


def network_keys(s: Sizes) -> Dict[str, Dict[str, object]]:
    """Values by kind and name of the bundle's keys."""
    u32 = {
        "policy.d_state": s.d_state,
        "policy.d_action": s.d_action,
        "policy.horizon": s.horizon,
        "vision.d_model": s.d_vision,
        "vision.n_layer": s.n_vision_layer,
        "vision.n_head": s.n_vision_head,
        "vision.d_ff": s.d_vision_ff,
        "vision.image_size": s.image_size,
        "vision.patch_size": s.patch_size,
        "lm.d_model": s.d_model,
        "lm.n_layer": s.n_layer,
        "lm.n_head": s.n_head,
        "lm.n_head_kv": s.n_head_kv,
        "lm.d_head": s.d_head,
        "lm.d_ff": s.d_ff,
        "lm.n_vocab": s.n_vocab,
        "expert.d_model": s.d_expert,
        "expert.n_layer": s.n_layer,
        "expert.d_ff": s.d_expert_ff,
        "solver.steps": s.n_step,
    }
    f32 = {
        "policy.text_scale": s.d_model**0.5,
        "vision.norm_eps": EPS,
        "lm.norm_eps": EPS,
        "lm.rope_base": ROPE_BASE,
        "expert.norm_eps": EPS,
        "expert.rope_base": ROPE_BASE,
    }
    f64 = {"time.min_period": s.min_period, "time.max_period": s.max_period, "solver.t_start": 1.0, "solver.t_end": 0.0}
    text = {"vision.position_rule": "row_major", "solver.kind": s.solver, "solver.noise": "normal"}
    return {"u32": u32, "f32": f32, "f64": f64, "string": text}

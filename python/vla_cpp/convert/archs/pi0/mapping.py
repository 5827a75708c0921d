# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Sizes of π0 and π0.5, and the names, storage and shapes of their tensors.

Its configuration knows two sizes by name; a `dims.json` beside it states others.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Dict, List, NamedTuple

from ...checkpoint import Checkpoint
from ...errors import Problems
from ...files import member, read_json
from ...layers import KEPT_OF_LAST, gated_block, linear, siglip, vector
from ...safetensors_file import Entry
from ...section import Section
from .. import TABLE, Dropped, Weight


class Family(NamedTuple):
    """In what the two differ."""

    arch: str
    config_class: str
    max_tokens: int  # what openpi's configurations allow; LeRobot's pipelines state it
    time_mlp: str  # the tensors of the time layers
    other_time_mlp: str  # what the other family calls them

    @property
    def state_token(self) -> bool:
        """π0 has the state as a token; π0.5 has it in the prompt and time in its norms."""
        return self.arch == "pi0"


DIMS_FILE = "dims.json"
# lerobot modeling_pi0.py (get_gemma_config) and openpi models/gemma.py (get_config).
VARIANTS = {
    "gemma_2b": dict(width=2048, depth=18, mlp_dim=16384, num_heads=8, num_kv_heads=1, head_dim=256),
    "gemma_300m": dict(width=1024, depth=18, mlp_dim=4096, num_heads=8, num_kv_heads=1, head_dim=256),
}
# SigLIP-So400m/14 as PaliGemma's config and modeling_pi0.py (PaliGemmaWithExpertModel) have it.
SIGLIP = dict(
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
    vision = Section(DIMS_FILE + ": vision", member(dims, "vision", dict, DIMS_FILE), SIGLIP, problems)
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
    """Sets the size of the images, which the reference wants square."""
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


# --- names. Releases of LeRobot, openpi and transformers moved the towers about and left prefixes out; a mapping needs one name for each
# tensor, and that is LeRobot's of today. Reference: lerobot policies/pi0/modeling_pi0.py (_fix_pytorch_state_dict_keys, from_pretrained).

ROOT = "model."
TOWERS = ROOT + "paligemma_with_expert."
PALIGEMMA = TOWERS + "paligemma."
VISION = PALIGEMMA + "model.vision_tower.vision_model."
PROJECTOR = PALIGEMMA + "model.multi_modal_projector.linear"
LM = PALIGEMMA + "model.language_model."
EMBEDDING = LM + "embed_tokens.weight"
LM_HEAD = PALIGEMMA + "lm_head.weight"
EXPERT = TOWERS + "gemma_expert.model."
EXPERT_HEAD = TOWERS + "gemma_expert.lm_head.weight"
# A prefix of another tree and what it is today. The first that fits counts.
MOVED = (
    (PALIGEMMA + "language_model.lm_head.", PALIGEMMA + "lm_head."),
    (PALIGEMMA + "language_model.model.", LM),
    (PALIGEMMA + "language_model.", LM),
    (PALIGEMMA + "vision_tower.", PALIGEMMA + "model.vision_tower."),
    (PALIGEMMA + "multi_modal_projector.", PALIGEMMA + "model.multi_modal_projector."),
)


def canonical(name: str, time_mlp: str, other_time_mlp: str) -> str:
    """Today's name. `time_mlp`: the family's word for its time layers, for which files may have the other family's."""
    if not name.startswith(ROOT):
        name = ROOT + name
    for old, new in MOVED:
        if name.startswith(old):
            name = new + name[len(old) :]
            break
    tower = PALIGEMMA + "model.vision_tower."
    if name.startswith(tower) and not name.startswith(VISION):
        name = VISION + name[len(tower) :]
    for end in ("_in.", "_out."):
        if name.startswith(ROOT + other_time_mlp + end):
            name = ROOT + time_mlp + name[len(ROOT + other_time_mlp) :]
    return name


def rename(
    tensors: Dict[str, Entry], time_mlp: str, other_time_mlp: str, notes: List[str], problems: Problems
) -> Dict[str, Entry]:
    renamed: Dict[str, Entry] = {}
    moved = []
    for stored, entry in tensors.items():
        name = canonical(stored, time_mlp, other_time_mlp)
        if name in renamed:
            problems.add("tensor " + stored, "one tensor of this meaning", "another one under " + renamed[name].name)
        renamed[name] = entry
        moved += [stored] if name != stored else []
    if moved:
        first = sorted(moved)[0]
        notes.append(
            "{} tensors under older or shorter names, such as {}, read as {}".format(
                len(moved), first, canonical(first, time_mlp, other_time_mlp)
            )
        )
    return renamed


def rounded(weight: Weight) -> bool:
    """What LeRobot rounds in bfloat16: neither the vision tower nor norms, nor the projections outside the towers
    (to_bfloat16_for_selected_params)."""
    return weight.target.startswith(("lm.", "expert.blk.")) and ".dense." not in weight.target


def weights(family: Family, s: Sizes, checkpoint: Checkpoint) -> List[Weight]:
    embedding = EMBEDDING if EMBEDDING in checkpoint.tensors else LM_HEAD
    return [
        *siglip(VISION, s.d_vision, s.d_vision_ff, s.n_vision_layer, s.patch_size, s.n_position),
        *linear("projector", PROJECTOR, s.d_model, s.d_vision, bias=True),
        Weight("lm.token_embd.weight", embedding, TABLE, (s.n_vocab, s.d_model), (s.n_vocab, s.d_model)),
        *_language(s),
        *_projections(family, s),
        *_expert(family, s),
        *linear("action_out", ROOT + "action_out_proj", s.d_action, s.d_expert, bias=True),
    ]


def _language_block(s: Sizes, i: int) -> Dict[str, List[Weight]]:
    target, source = "lm.blk.{}.".format(i), "{}layers.{}.".format(LM, i)
    d_kv = s.n_head_kv * s.d_head
    block = gated_block(target, source, s.d_model, s.n_head * s.d_head, d_kv, s.d_model, s.d_ff)
    return {part: [_plus_one(weight) for weight in rows] if "norm" in part else rows for part, rows in block.items()}


def _plus_one(weight: Weight) -> Weight:
    return weight._replace(plus_one=True)


def _language(s: Sizes) -> List[Weight]:
    return [
        weight
        for i in range(s.n_layer)
        for part, rows in _language_block(s, i).items()
        if i < s.n_layer - 1 or part in KEPT_OF_LAST
        for weight in rows
    ]


def _projections(family: Family, s: Sizes) -> List[Weight]:
    d, root = s.d_expert, ROOT
    rows = linear("action_in", root + "action_in_proj", d, s.d_action, bias=True)
    if not family.state_token:
        rows += linear("time_mlp_in", root + "time_mlp_in", d, d, bias=True)
        return rows + linear("time_mlp_out", root + "time_mlp_out", d, d, bias=True)
    rows += linear("state_in", root + "state_proj", d, s.d_state, bias=True)
    rows += linear("action_time_in", root + "action_time_mlp_in", d, 2 * d, bias=True)
    return rows + linear("action_time_out", root + "action_time_mlp_out", d, d, bias=True)


def _expert(family: Family, s: Sizes) -> List[Weight]:
    rows: List[Weight] = []
    for i in range(s.n_layer):
        target, source = "expert.blk.{}.".format(i), "{}layers.{}.".format(EXPERT, i)
        d_kv = s.n_head_kv * s.d_head
        block = gated_block(target, source, s.d_expert, s.n_head * s.d_head, d_kv, s.d_expert, s.d_expert_ff)
        block["attn_norm"] = _expert_norm(family, s, target + "attn_norm", source + "input_layernorm")
        block["ffn_norm"] = _expert_norm(family, s, target + "ffn_norm", source + "post_attention_layernorm")
        rows += [weight for part in block.values() for weight in part]
    return rows + _expert_norm(family, s, "expert.norm", EXPERT + "norm")


def _expert_norm(family: Family, s: Sizes, target: str, source: str) -> List[Weight]:
    if family.state_token:
        return [_plus_one(weight) for weight in vector(target + ".weight", source + ".weight", s.d_expert)]
    return linear(target + ".dense", source + ".dense", 3 * s.d_expert, s.d_expert, bias=True)


def dropped(family: Family, s: Sizes, checkpoint: Checkpoint) -> List[Dropped]:
    last = [
        weight for part, rows in _language_block(s, s.n_layer - 1).items() if part not in KEPT_OF_LAST for weight in rows
    ]
    head = [Dropped(LM_HEAD, (s.n_vocab, s.d_model), "the embedding table is stored under its own name too")]
    rows = [
        *(head if EMBEDDING in checkpoint.tensors else []),
        Dropped(EXPERT_HEAD, (s.n_vocab, s.d_expert), "no action depends on the expert's language head"),
        Dropped(LM + "norm.weight", (s.d_model,), "the prefix leaves only keys and values"),
        *(Dropped(row.source, row.stored, "the last language layer leaves only keys and values") for row in last),
    ]
    if family.state_token:
        return rows
    # The reference's loader passes these over in a checkpoint of π0.5.
    reason = "π0.5 has its state in the prompt and its norms without weights of their own"
    norms = ["{}layers.{}.{}.weight".format(EXPERT, i, n) for i in range(s.n_layer) for n in NORMS]
    rows += [Dropped(name, (s.d_expert,), reason) for name in [*norms, EXPERT + "norm.weight"]]
    rows.append(Dropped(ROOT + "state_proj.weight", (s.d_expert, s.d_action), reason))
    return [*rows, Dropped(ROOT + "state_proj.bias", (s.d_expert,), reason)]


NORMS = ("input_layernorm", "post_attention_layernorm")


def hints(s: Sizes) -> Dict[str, str]:
    text = "the {} layers are 0 to {}".format("{}", s.n_layer - 1)
    return {
        LM + "layers.": text.format("language model's"),
        EXPERT + "layers.": text.format("expert's"),
        VISION + "encoder.layers.": "the tower's layers are 0 to {}".format(s.n_vision_layer - 1),
    }

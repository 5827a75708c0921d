# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Sizes of π0 and π0.5, and the names, storage and shapes of their tensors.

The reference's config names one of two sizes; a `dims.json` beside it states others.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from typing import Dict, List, NamedTuple

from ...bundle import Key
from ...checkpoint import Checkpoint
from ...errors import Problems
from ...files import member, read_json
from ...layers import GEMMA, Decoder, Rows, linear
from ...networks import MAX_LAYERS, Language, Vision, decoder, defaults, dropped_of_last, expert, keys_of, pick, read_vision, siglip
from ...safetensors_file import Entry
from ...section import Section
from .. import Dropped, Weight


class Family(NamedTuple):
    """The differences between π0 and π0.5."""

    arch: str
    config_class: str
    max_tokens: int  # limit in openpi's configurations; LeRobot's pipelines state their own
    time_mlp: str  # name of the time layers
    other_time_mlp: str  # name of the time layers in the other family

    @property
    def state_token(self) -> bool:
        """Whether the state is a token, as in π0. In π0.5 the state is in the prompt and the time enters through norms."""
        return self.arch == "pi0"


DIMS_FILE = "dims.json"
# Sizes in lerobot modeling_pi0.py (get_gemma_config) and openpi models/gemma.py (get_config).
VARIANTS = {
    "gemma_2b": dict(width=2048, depth=18, mlp_dim=16384, num_heads=8, num_kv_heads=1, head_dim=256),
    "gemma_300m": dict(width=1024, depth=18, mlp_dim=4096, num_heads=8, num_kv_heads=1, head_dim=256),
}
# SigLIP-So400m/14, as in PaliGemma's config and modeling_pi0.py (PaliGemmaWithExpertModel).
SIGLIP = defaults(1152, 4304, 27, 16, patch_size=14, image_size=0)
N_VOCAB = 257152
EPS, ROPE_BASE = 1e-6, 10000.0  # fixed for both Gemmas and the tower: no config states other values


@dataclass
class Sizes:
    vision: Vision = field(default_factory=Vision)
    lm: Language = field(default_factory=Language)
    d_expert: int = 0
    d_expert_ff: int = 0
    state_dim: int = 0  # the robot's widths
    action_dim: int = 0
    d_state: int = 0  # the network's widths
    d_action: int = 0
    horizon: int = 0
    n_step: int = 0
    min_period: float = 0.0
    max_period: float = 0.0
    solver: str = "euler"


def read_towers(policy: Section, checkpoint: Checkpoint, problems: Problems) -> Sizes:
    """The sizes of the vision tower, the language model and the expert; `policy` names the variants of the last two."""
    dims = _dims(checkpoint, problems)
    lm, expert = (_gemma(policy, key, dims, checkpoint, problems) for key in ("paligemma_variant", "action_expert_variant"))
    for key in ("depth", "num_heads", "num_kv_heads", "head_dim"):
        if lm.count(key) != expert.count(key):
            expert.bad(key, "that of the language model, {}: the layers attend together".format(lm.count(key)))
    if expert.count("width") % 2:
        expert.bad("width", "an even number, for the time embedding")
    sizes = _paligemma(dims, lm, problems)
    sizes.d_expert, sizes.d_expert_ff = expert.count("width"), expert.count("mlp_dim")
    return sizes


def read_paligemma(policy: Section, checkpoint: Checkpoint, problems: Problems) -> Sizes:
    """The sizes of the vision tower and the language model, for a policy without an expert."""
    dims = _dims(checkpoint, problems)
    return _paligemma(dims, _gemma(policy, "paligemma_variant", dims, checkpoint, problems), problems)


def _paligemma(dims: dict, lm: Section, problems: Problems) -> Sizes:
    vision = Section(DIMS_FILE + ": vision", member(dims, "vision", dict, DIMS_FILE), SIGLIP, problems)
    _known(vision)
    if lm.count("num_heads") % lm.count("num_kv_heads"):
        lm.bad("num_kv_heads", "a divisor of num_heads {}".format(lm.count("num_heads")))
    if lm.count("head_dim") % 2:
        lm.bad("head_dim", "an even number, for the rotary embedding")
    top = Section(DIMS_FILE, dims, {"vocab_size": N_VOCAB}, problems)
    image_size = vision.count("image_size", 0) if "image_size" in vision.values else 0
    tower = read_vision(vision, image_size, vision.count("patch_size"))
    tower.norm_eps = EPS
    language = Language(
        d_model=lm.count("width"),
        n_layer=lm.count("depth", maximum=MAX_LAYERS),
        n_head=lm.count("num_heads"),
        n_head_kv=lm.count("num_kv_heads"),
        d_head=lm.count("head_dim"),
        d_ff=lm.count("mlp_dim"),
        n_vocab=top.count("vocab_size"),
        norm_eps=EPS,
        rope_base=ROPE_BASE,
    )
    return Sizes(tower, language)


def check_image(policy: Section, key: str, sizes: Sizes, resolution) -> None:
    """Sets the size of the images, which must be square as in the reference."""
    square = isinstance(resolution, list) and len(resolution) == 2 and resolution[0] == resolution[1]
    side = resolution[0] if square else 0
    if type(side) is not int or not sizes.vision.patch_size <= side <= 8192:
        policy.bad(key, "two equal sides from patch_size {} to 8192".format(sizes.vision.patch_size), repr(resolution))
        side = sizes.vision.patch_size
    if sizes.vision.image_size not in (0, side):
        policy.bad(key, "the image_size of {}, {}".format(DIMS_FILE, sizes.vision.image_size), repr(resolution))
    sizes.vision.image_size = side


def _dims(checkpoint: Checkpoint, problems: Problems) -> dict:
    if not os.path.exists(checkpoint.path(DIMS_FILE)):
        return {}
    dims = read_json(checkpoint.path(DIMS_FILE))
    for key in sorted(set(dims) - {"size", "vision", "vocab_size", *VARIANTS}):
        problems.unsupported("{}: {}".format(DIMS_FILE, key), "vision, vocab_size or a Gemma variant", repr(dims[key])[:80])
    checkpoint.notes.append("sizes: from {} where it states them".format(DIMS_FILE))
    return dims


LORA = "openpi's converter to PyTorch leaves LoRA out: give the folder that its training wrote, with params/"


def _gemma(policy: Section, key: str, dims: dict, checkpoint: Checkpoint, problems: Problems) -> Section:
    variant = policy.get(key)
    if any(getattr(tensor, "has_adapter", False) for tensor in checkpoint.tensors.values()) and isinstance(variant, str):
        variant = variant[: -len("_lora")] if variant.endswith("_lora") else variant
    if not isinstance(variant, str) or variant not in VARIANTS:
        policy.bad(key, " or ".join(VARIANTS), unsupported=True, hint=LORA)
        variant = "gemma_300m"
    section = Section("{}: {}".format(DIMS_FILE, variant), member(dims, variant, dict, DIMS_FILE), VARIANTS[variant], problems)
    _known(section)
    return section


def _known(section: Section) -> None:
    for key in sorted(set(section.values) - set(section.defaults)):
        section.bad(key, "one of " + ", ".join(section.defaults), unsupported=True)


def network_keys(s: Sizes) -> List[Key]:
    return keys_of(
        {
            "policy": dict(pick(s, "d_state d_action horizon"), text_scale=s.lm.d_model**0.5),
            "vision": {**vars(s.vision), "position_rule": "row_major"},
            "lm": s.lm,
            "expert": dict(d_model=s.d_expert, n_layer=s.lm.n_layer, d_ff=s.d_expert_ff, norm_eps=EPS, rope_base=ROPE_BASE),
            "time": pick(s, "min_period max_period"),
            "solver": dict(steps=s.n_step, t_start=1.0, t_end=0.0, kind=s.solver, noise="normal"),
        }
    )


# --- names. Releases of LeRobot, openpi and transformers use different prefixes of the towers. A mapping needs one name per tensor: the name in
# LeRobot's current release. Reference: lerobot policies/pi0/modeling_pi0.py (_fix_pytorch_state_dict_keys, from_pretrained).

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
# Prefix in another release -> current prefix. The first match applies.
MOVED = (
    (PALIGEMMA + "language_model.lm_head.", PALIGEMMA + "lm_head."),
    (PALIGEMMA + "language_model.model.", LM),
    (PALIGEMMA + "language_model.", LM),
    (PALIGEMMA + "vision_tower.", PALIGEMMA + "model.vision_tower."),
    (PALIGEMMA + "multi_modal_projector.", PALIGEMMA + "model.multi_modal_projector."),
)


def canonical(name: str, time_mlp: str, other_time_mlp: str) -> str:
    """The current name of a tensor. `time_mlp`: the family's name of its time layers; files may have the other family's name."""
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


def rename(tensors: Dict[str, Entry], time_mlp: str, other_time_mlp: str, notes: List[str], problems: Problems) -> Dict[str, Entry]:
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
    """Whether LeRobot rounds this weight in a bfloat16 policy: all except the vision tower, norms, and the projections outside the towers
    (to_bfloat16_for_selected_params)."""
    return weight.target.startswith(("lm.", "expert.blk.")) and ".dense." not in weight.target


def paligemma(s: Sizes, checkpoint: Checkpoint, end: str) -> Rows:
    """Rows of PaliGemma. `end`: as in networks.decoder."""
    return [
        *siglip(VISION, s.vision),
        *linear("projector", PROJECTOR, s.lm.d_model, s.vision.d_model),
        *decoder(s.lm, LM, GEMMA, end, EMBEDDING if EMBEDDING in checkpoint.tensors else LM_HEAD),
    ]


def weights(family: Family, s: Sizes, checkpoint: Checkpoint) -> Rows:
    d = s.d_expert
    return [
        *paligemma(s, checkpoint, "cache"),
        *linear("action_in", ROOT + "action_in_proj", d, s.d_action),
        *(linear("state_in", ROOT + "state_proj", d, s.d_state) if family.state_token else []),
        *_time(family, s),
        *expert(EXPERT, d, s.d_expert_ff, s.lm, GEMMA if family.state_token else ADAPTIVE),
        *linear("action_out", ROOT + "action_out_proj", s.d_action, d),
    ]


def _time(family: Family, s: Sizes) -> Rows:
    target, d = "action_time" if family.state_token else "time_mlp", s.d_expert
    source = ROOT + family.time_mlp
    return linear(target + "_in", source + "_in", d, 2 * d if family.state_token else d) + linear(target + "_out", source + "_out", d, d)


def _adaptive_norm(target: str, source: str, d: int) -> Rows:
    return linear(target + ".dense", source + ".dense", 3 * d, d)


ADAPTIVE = Decoder(_adaptive_norm)


def dropped(family: Family, s: Sizes, checkpoint: Checkpoint) -> List[Dropped]:
    head = [Dropped(LM_HEAD, (s.lm.n_vocab, s.lm.d_model), "the embedding table is stored under its own name too")]
    rows = [
        *(head if EMBEDDING in checkpoint.tensors else []),
        Dropped(EXPERT_HEAD, (s.lm.n_vocab, s.d_expert), "no action depends on the expert's language head"),
        *dropped_of_last(s.lm, LM),
    ]
    if family.state_token:
        return rows
    # The reference's loader ignores these tensors in a checkpoint of π0.5.
    reason = "π0.5 has its state in the prompt and its norms without weights of their own"
    norms = ["{}layers.{}.{}.weight".format(EXPERT, i, n) for i in range(s.lm.n_layer) for n in NORMS]
    rows += [Dropped(name, (s.d_expert,), reason) for name in [*norms, EXPERT + "norm.weight"]]
    rows.append(Dropped(ROOT + "state_proj.weight", (s.d_expert, s.d_action), reason))
    return [*rows, Dropped(ROOT + "state_proj.bias", (s.d_expert,), reason)]


NORMS = ("input_layernorm", "post_attention_layernorm")


def hints(s: Sizes) -> Dict[str, str]:
    text = "the {} layers are 0 to {}".format("{}", s.lm.n_layer - 1)
    return {
        LM + "layers.": text.format("language model's"),
        EXPERT + "layers.": text.format("expert's"),
        VISION + "encoder.layers.": "the tower's layers are 0 to {}".format(s.vision.n_layer - 1),
    }

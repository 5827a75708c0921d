# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Names of the tensors of π0 and π0.5. Releases of LeRobot, openpi and transformers moved the towers about and left prefixes out; a
mapping needs one name for each tensor, and that is LeRobot's of today.

Reference: lerobot policies/pi0/modeling_pi0.py (_fix_pytorch_state_dict_keys, from_pretrained).
"""

from __future__ import annotations

from typing import Dict, List

from ..errors import Problems
from ..safetensors_file import Entry

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

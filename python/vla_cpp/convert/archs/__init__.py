# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""One package or module per architecture, named as in the checkpoint's `type`. Each has `plan(checkpoint, options, problems) -> Plan`,
`embodiments(checkpoint)`, their tags, where a checkpoint holds several robots, and `LAYOUT` where its authors do not save it as LeRobot does."""

from __future__ import annotations

import importlib
import pkgutil
from dataclasses import dataclass, field
from typing import Dict, List, NamedTuple, Optional, Sequence, Tuple

import numpy as np

from ..bundle import Key
from ..checkpoint import LEROBOT, OPENPI, Layout
from ..errors import Code, Problems, refuse

MATRIX, TABLE, VECTOR = "matrix", "table", "vector"
TERNARY, SCALE = "ternary", "scale"  # of a matrix of -1, 0 and 1 and one factor: its codes, and the factor


class Weight(NamedTuple):
    """One row of a mapping: the bundle's name, the checkpoint's name, storage class, the checkpoint's shape, the bundle's shape."""

    target: str
    source: str
    kind: str
    stored: Tuple[int, ...]
    shape: Tuple[int, ...]
    plus_one: bool = False  # a norm of Gemma, which multiplies by 1 + w: the bundle holds the sum, a vector in float32
    keep_f32: bool = False  # a matrix that the reference keeps in float32 in bfloat16 too: not rounded if stored so
    first: Optional[int] = None  # of a source that stacks several tensors: the row at which this one's shape[0] rows begin
    pick: Optional[Tuple[int, int]] = None  # one index of one axis of the source: (axis, index)
    transpose: bool = False  # what is left after `pick`, stored as (in, out)
    in_bf16: bool = False  # the reference rounds it to bfloat16 when it loads it, whatever it is stored as
    regroup: int = 0  # the last axis is stored as groups of this many numbers: the bundle has all first ones, all second ones, ...


class Dropped(NamedTuple):
    """A tensor that the checkpoint may have and the policy never reads, with the reason."""

    source: str
    stored: Tuple[int, ...]
    reason: str


@dataclass
class Options:
    """What a person chose beyond the checkpoint. Empty means: as the checkpoint says."""

    backbone: str = ""
    dtype: str = ""
    dataset_info: str = ""
    identity_stats: Sequence[str] = ()
    state_bound: Optional[float] = None  # of a normalized number of the state; the runtime's own where it is not said
    position_precision: str = ""
    variant: str = ""  # openpi's name of a training configuration, or the revision of Evo-1's code: checkpoints do not state them
    stats: str = ""  # Evo-1: which entry of norm_stats.json, ARM/DATASET; BitVLA: which of dataset_statistics.json
    views: Sequence[str] = ()  # Evo-1, BitVLA: names of the cameras in the order of the prompt's slots
    max_views: int = 0  # Evo-1: places for views in the prompt
    embodiment: str = ""  # GR00T: the robot, by its tag in the checkpoint; several with commas, or `all`
    camera_size: str = ""  # GR00T: WIDTHxHEIGHT of images whose aspect the pipeline keeps; they are square without it
    gripper_sign: str = ""  # GR00T: the key of a gripper's actions, which become -1 where it opens and 1 where it closes
    letterbox: bool = False  # GR00T: images are padded to squares, as the authors' later servers do
    masked_rows: str = ""  # Evo-1: what the reference's attention leaves in rows that are masked


@dataclass
class Plan:
    """Everything of a bundle but the numbers of the weights."""

    keys: List[Key]
    weights: List[Weight]
    dropped: List[Dropped]
    statistics: Dict[str, np.ndarray]
    hints: Dict[str, str] = field(
        default_factory=dict
    )  # prefix of an unexpected tensor's name -> why it is not expected


def names() -> List[str]:
    """What has a function `plan`; a package without one holds parts of several architectures."""
    found = (module.name for module in pkgutil.iter_modules(__path__))
    return sorted(name for name in found if callable(getattr(_module(name), "plan", None)))


def _module(name):
    return importlib.import_module("." + name, __name__)


# Types of LeRobot whose policies are read in another layout.
OTHER_LAYOUTS = {"groot": "a fine-tune of GR00T as LeRobot saves it is not read yet, GR00T as its authors publish it is"}


def load(name):
    """The module of an architecture. Errors: unsupported."""
    if name not in names():
        hint = OTHER_LAYOUTS.get(str(name), "")
        raise refuse("config.json: type", "one of " + ", ".join(names()), str(name), hint, Code.UNSUPPORTED)
    return _module(name)


LAYOUTS = {
    LEROBOT: Layout("LeRobot", ("identity_stats", "position_precision")),
    OPENPI: Layout("openpi", ("variant",)),
}


def authors() -> Dict[str, Layout]:
    """Layouts of the authors, by architecture."""
    return {name: _module(name).LAYOUT for name in names() if hasattr(_module(name), "LAYOUT")}


def check_options(layout: str, config: dict, options: Options) -> None:
    """Refuses options that a layout does not leave open. Errors: usage."""
    problems, layouts = Problems("arguments"), {**LAYOUTS, **authors()}
    for name in dict.fromkeys(option for each in layouts.values() for option in each.options):
        if getattr(options, name) and name not in layouts[layout].options:
            *most, last = [each.name for each in layouts.values() if name in each.options]
            wanted = "a checkpoint of " + ", ".join(most) + (" or " if most else "") + last
            found = "one of " + layouts[layout].name
            if layout == LEROBOT:
                found = "config.json of type {}, which states everything itself".format(config.get("type"))
            problems.add("--" + name.replace("_", "-"), wanted, found, "leave the option out", Code.USAGE)
    problems.raise_any()


def arch_of(config: dict, layout: str, variant: str) -> str:
    """LeRobot states the architecture; in an openpi checkpoint nothing does, and `variant` names the configuration that it
    was trained with. Errors: usage, unsupported."""
    if layout == LEROBOT and "type" not in config and "model_type" in config:
        known = [name for each in authors().values() for name in each.model_types]
        raise refuse("config.json: model_type", "one of " + ", ".join(known), str(config["model_type"]), "", Code.UNSUPPORTED)
    if layout != OPENPI:
        return config.get("type") if layout == LEROBOT else layout
    variants = {name: arch for arch in names() for name in getattr(load(arch), "VARIANTS", ())}
    if variant in variants:
        return variants[variant]
    raise refuse(
        "--variant",
        "the name of the openpi configuration that the checkpoint was trained with: " + ", ".join(sorted(variants)),
        variant or "none",
        "an openpi checkpoint does not state its robot; other variants have recipes that are not known",
        Code.UNSUPPORTED if variant else Code.USAGE,
    )

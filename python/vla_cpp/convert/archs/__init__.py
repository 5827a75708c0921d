# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""One package or module per architecture, named as in the checkpoint's `type`. Each has `plan(checkpoint, options, problems) -> Plan`,
`embodiments(checkpoint)`, their tags, where a checkpoint holds several robots, and `LAYOUT` where its authors do not save it as LeRobot does, with the options that
such a checkpoint leaves open."""

from __future__ import annotations

import importlib
import pkgutil
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any, Dict, List, NamedTuple, Optional, Sequence, Tuple, Union

import numpy as np

from ..bundle import Key
from ..checkpoint import LEROBOT, OPENPI, Checkpoint, Layout, Tensors, read_stored
from ..errors import Code, Problems, refuse
from ..options import ACTION_TOKENIZER, COMMON, DOMAIN, IDENTITY_STATS, POSITION_PRECISION, WIDTHS, Option, stats, variant
from ..standardized import Standardized

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
    pick: Optional[Tuple[int, Union[int, Sequence[int]]]] = None  # one index of one axis of the source, or several: (axis, index)
    transpose: bool = False  # what is left after `pick`, stored as (in, out)
    in_bf16: bool = False  # the reference rounds it to bfloat16 when it loads it, whatever it is stored as
    batch_norm: str = ""  # a convolution's matrix, or the bias that it gets, with the frozen batch norm of this name behind it
    pixels: Optional[Standardized] = None  # of a patch embedding and its bias: it reads standardized pixels, the bundle's those from 0 to 1
    axes: Tuple[int, ...] = ()  # the source's axes in the order in which the bundle has them
    regroup: int = 0  # the last axis is stored as groups of this many numbers: the bundle has all first ones, all second ones, ...


class Dropped(NamedTuple):
    """A tensor that the checkpoint may have and the policy never reads, with the reason."""

    source: str
    stored: Tuple[int, ...]
    reason: str


class Options(SimpleNamespace):
    """What a person chose beyond the checkpoint, by the names of options: those of every checkpoint, and those that layouts declare."""

    def __init__(self, **chosen: Any) -> None:
        values = {option.name: option.default for option in (*COMMON, *(option for option, _ in declared()))}
        if unknown := sorted(set(chosen) - set(values)):
            raise TypeError("no option {}; there are {}".format(", ".join(unknown), ", ".join(values)))
        super().__init__(**{**values, **chosen})

    def replaced(self, **chosen: Any) -> Options:
        return Options(**{**vars(self), **chosen})


@dataclass
class Plan:
    """Everything of a bundle but the numbers of the weights."""

    keys: List[Key]
    weights: List[Weight]
    dropped: List[Dropped]
    statistics: Dict[str, np.ndarray]
    hints: Dict[str, str] = field(default_factory=dict)  # prefix of an unexpected tensor's name -> why it is not expected


def names() -> List[str]:
    """What has a function `plan`; a package without one holds parts of several architectures."""
    found = (module.name for module in pkgutil.iter_modules(__path__))
    return sorted(name for name in found if callable(getattr(_module(name), "plan", None)))


def _module(name):
    return importlib.import_module("." + name, __name__)


def load(name):
    """The module of an architecture. Errors: unsupported."""
    if name not in names():
        raise refuse("config.json: type", "one of " + ", ".join(names()), str(name), "", Code.UNSUPPORTED)
    return _module(name)


def groot_as_published(checkpoint: Checkpoint, options: Options) -> Options:
    """Of LeRobot's GR00T: the checkpoint in the authors' layout."""
    return _module("gr00t.lerobot_layout").as_published(checkpoint, options)


def _openpi_tensors(folder: str, problems: Problems) -> Tensors:
    jax = _module("pi0.jax_layout")
    return jax.read_jax(folder, problems) if jax.is_jax(folder) else read_stored(folder, problems)


LAYOUTS = {
    LEROBOT: Layout(
        "LeRobot", (IDENTITY_STATS, POSITION_PRECISION, WIDTHS, DOMAIN, ACTION_TOKENIZER, stats("whose, where the weights have those of several data sets"))
    ),
    OPENPI: Layout("openpi", (variant("the training configuration, e.g. pi05_droid"),), files=("params/_METADATA",), read=_openpi_tensors),
}


def told_by_files() -> Dict[str, Layout]:
    """The layouts that have a reader or files of their own."""
    return {**authors(), OPENPI: LAYOUTS[OPENPI]}


def authors() -> Dict[str, Layout]:
    """Layouts of the authors, by architecture."""
    return {name: _module(name).LAYOUT for name in names() if hasattr(_module(name), "LAYOUT")}


def declared() -> List[Tuple[Option, Dict[str, str]]]:
    """Every option that a layout declares, with the help of each layout by its name."""
    found: Dict[str, Tuple[Option, Dict[str, str]]] = {}
    for layout in (*LAYOUTS.values(), *authors().values()):
        for option in layout.options:
            found.setdefault(option.name, (option, {}))[1][layout.name] = option.help
    return list(found.values())


# What names of tensors of a LeRobot policy begin with, that no other one has.
PALIGEMMA = "model.paligemma_with_expert."
TELLING = {
    "smolvla": ("model.vlm_with_expert.",),
    "pi0": (PALIGEMMA, "model.action_time_mlp_in."),
    "pi05": (PALIGEMMA, "model.time_mlp_in."),
    "act": ("model.encoder_latent_input_proj.",),
    "diffusion": ("diffusion.unet.",),
    "xvla": ("model.vlm.", "model.transformer."),
    "evo1": ("model.embedder.model.",),
    "turbovla": ("model.vl_interaction.",),
    "vla_jepa": ("model.qwen.",),
}


def told_by_tensors(checkpoint: Checkpoint) -> None:
    """Of a LeRobot config without a type: the only architecture that has its tensors."""
    names = list(checkpoint.tensors)
    found = [arch for arch, all_of in TELLING.items() if all(any(name.startswith(one) for name in names) for one in all_of)]
    if len(found) == 1 and "type" not in checkpoint.config and "model_type" not in checkpoint.config:
        checkpoint.config["type"] = found[0]
        checkpoint.notes.append("config.json states no type: read as {}, the only policy with such tensors".format(found[0]))


def check_options(layout: str, config: dict, options: Options) -> None:
    """Refuses options that a layout does not leave open. Errors: usage."""
    problems, own = Problems("arguments"), {**LAYOUTS, **authors()}[layout].name
    for option, layouts in declared():
        if getattr(options, option.name) and own not in layouts:
            *most, last = layouts
            wanted = "a checkpoint of " + ", ".join(most) + (" or " if most else "") + last
            found = "one of " + own
            if layout == LEROBOT:
                found = "config.json of type {}, which states everything itself".format(config.get("type"))
            problems.add(option.flag, wanted, found, "leave the option out", Code.USAGE)
    if options.action_tokenizer and layout == LEROBOT and config.get("type") != "pi0_fast":
        problems.add(ACTION_TOKENIZER.flag, "a checkpoint of π0-FAST", "type {}".format(config.get("type")), "leave the option out", Code.USAGE)
    problems.raise_any()


def arch_of(checkpoint: Checkpoint, variant: str) -> str:
    """LeRobot states the architecture; in an openpi checkpoint nothing does, and `variant` names the configuration that it
    was trained with, or a file that states it. Errors: usage, unsupported."""
    config, layout = checkpoint.config, checkpoint.layout
    if layout == LEROBOT and "type" not in config and "model_type" in config:
        known = dict.fromkeys(name for each in authors().values() for name in each.model_types)
        raise refuse("config.json: model_type", "one of " + ", ".join(known), str(config["model_type"]), "", Code.UNSUPPORTED)
    if layout != OPENPI:
        return config.get("type") if layout == LEROBOT else layout
    variants = {name: arch for arch in names() for name in getattr(load(arch), "VARIANTS", ())}
    if variant in variants:
        return variants[variant]
    if variant.endswith(".json"):
        return load("pi0").read_variant(checkpoint, variant).arch
    raise refuse(
        "--variant",
        "the name of the openpi configuration that the checkpoint was trained with, or a JSON file with one: " + ", ".join(sorted(variants)),
        variant or "none",
        "an openpi checkpoint does not state its robot; docs/converting.md has the fields of a configuration of one's own",
        Code.UNSUPPORTED if variant else Code.USAGE,
    )

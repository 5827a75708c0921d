# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""One package or module per architecture, named like the checkpoint's `type`.

plan(checkpoint, options, problems)  the Plan of the bundle
embodiments(checkpoint)              tags of the robots, if a checkpoint has several
LAYOUT                               the layout of the architecture's authors, if it is not LeRobot's, with its options
"""

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
TERNARY, SCALE = "ternary", "scale"  # a matrix of -1, 0 and 1 times a factor: its codes, and the factor


class Weight(NamedTuple):
    """One row of a mapping. target: the bundle's name; source: the checkpoint's name; kind: storage class; stored: the checkpoint's shape;
    shape: the bundle's shape."""

    target: str
    source: str
    kind: str
    stored: Tuple[int, ...]
    shape: Tuple[int, ...]
    plus_one: bool = False  # a norm that multiplies by 1 + w, as Gemma's: the bundle stores the sum, a float32 vector
    keep_f32: bool = False  # a matrix that the reference keeps in float32 also in a bfloat16 network: not rounded if stored in float32
    first: Optional[int] = None  # if the source stacks several tensors: the first of this tensor's shape[0] rows
    pick: Optional[Tuple[int, Union[int, Sequence[int]]]] = None  # (axis, index): one or several indices of one axis of the source
    transpose: bool = False  # the result of `pick` is stored as (in, out)
    in_bf16: bool = False  # the reference rounds it to bfloat16 on loading, from any stored type
    batch_norm: str = ""  # name of the frozen batch norm that is folded into this convolution's matrix or bias
    pixels: Optional[Standardized] = None  # for a patch embedding and its bias: the standardization of pixels to fold in
    axes: Tuple[int, ...] = ()  # permutation of the source's axes to the bundle's order
    regroup: int = 0  # group size on the source's last axis; the bundle stores all first numbers, then all second ones, ...


class Dropped(NamedTuple):
    """A tensor that the checkpoint may have and the policy never reads, with the reason."""

    source: str
    stored: Tuple[int, ...]
    reason: str


class Options(SimpleNamespace):
    """The user's options by name: those of every checkpoint, and those that layouts declare."""

    def __init__(self, **chosen: Any) -> None:
        values = {option.name: option.default for option in (*COMMON, *(option for option, _ in declared()))}
        if unknown := sorted(set(chosen) - set(values)):
            raise TypeError("no option {}; there are {}".format(", ".join(unknown), ", ".join(values)))
        super().__init__(**{**values, **chosen})

    def replaced(self, **chosen: Any) -> Options:
        return Options(**{**vars(self), **chosen})


@dataclass
class Plan:
    """Everything in a bundle except the numbers of the weights."""

    keys: List[Key]
    weights: List[Weight]
    dropped: List[Dropped]
    statistics: Dict[str, np.ndarray]
    hints: Dict[str, str] = field(default_factory=dict)  # prefix of an unexpected tensor's name -> the reason for its refusal


def names() -> List[str]:
    """The architectures: modules with a function `plan`. A package without it has parts of several architectures."""
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
    """Converts a checkpoint of LeRobot's GR00T in place to the authors' layout. Returns the options with the checkpoint's only robot."""
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
    """The layouts with their own reader or files."""
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


# Prefixes of tensor names that identify a LeRobot policy: only this one has all of them.
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
    """Sets the type in a LeRobot config without one, if the tensor names match exactly one architecture."""
    names = list(checkpoint.tensors)
    found = [arch for arch, all_of in TELLING.items() if all(any(name.startswith(one) for name in names) for one in all_of)]
    if len(found) == 1 and "type" not in checkpoint.config and "model_type" not in checkpoint.config:
        checkpoint.config["type"] = found[0]
        checkpoint.notes.append("config.json states no type: read as {}, the only policy with such tensors".format(found[0]))


def check_options(layout: str, config: dict, options: Options) -> None:
    """Refuses options that the layout does not declare. Errors: usage."""
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
    """The checkpoint's architecture. LeRobot's config states it; for openpi's layout `variant` names the training configuration, or a file
    with one. Errors: usage, unsupported."""
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

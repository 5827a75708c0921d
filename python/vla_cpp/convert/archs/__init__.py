# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""One module per architecture, named as in the checkpoint's `type`. Each has `plan(checkpoint, options, problems) -> Plan`."""

from __future__ import annotations

import importlib
import pkgutil
from dataclasses import dataclass, field
from typing import Dict, List, NamedTuple, Sequence, Tuple

import numpy as np

from ..bundle import Key
from ..errors import Code, refuse

MATRIX, TABLE, VECTOR = "matrix", "table", "vector"


class Weight(NamedTuple):
    """One row of a mapping: the bundle's name, the checkpoint's name, storage class, the checkpoint's shape, the bundle's shape."""

    target: str
    source: str
    kind: str
    stored: Tuple[int, ...]
    shape: Tuple[int, ...]
    plus_one: bool = False  # a norm of Gemma, which multiplies by 1 + w: the bundle holds the sum, a vector in float32
    keep_f32: bool = False  # a matrix that the reference keeps in float32 in bfloat16 too: not rounded if stored so


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
    position_precision: str = ""
    variant: str = ""  # openpi's name of a training configuration, which its checkpoints do not state


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
    """Modules with a leading underscore are parts of an architecture's."""
    return sorted(module.name for module in pkgutil.iter_modules(__path__) if not module.name.startswith("_"))


def load(name):
    """The module of an architecture. Errors: unsupported."""
    if name not in names():
        raise refuse("config.json: type", "one of " + ", ".join(names()), str(name), code=Code.UNSUPPORTED)
    return importlib.import_module("." + name, __name__)


def arch_of(config: dict, is_openpi: bool, variant: str) -> str:
    """LeRobot states the architecture; in an openpi checkpoint nothing does, and `variant` names the configuration that it
    was trained with. Errors: usage, unsupported."""
    variants = {name: arch for arch in names() for name in getattr(load(arch), "VARIANTS", ())}
    if not is_openpi:
        if variant:
            raise refuse(
                "--variant " + variant,
                "an openpi checkpoint",
                "config.json of type {}, which states everything itself".format(config.get("type")),
                "leave the option out",
                Code.USAGE,
            )
        return config.get("type")
    if variant in variants:
        return variants[variant]
    raise refuse(
        "--variant",
        "the name of the openpi configuration that the checkpoint was trained with: " + ", ".join(sorted(variants)),
        variant or "none",
        "an openpi checkpoint does not state its robot; other variants have recipes that are not known",
        Code.UNSUPPORTED if variant else Code.USAGE,
    )

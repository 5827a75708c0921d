# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Puts several robots of a checkpoint into one bundle: shared parts are stored once, differing parts under each robot's tag."""

from __future__ import annotations

from typing import Any, Dict, List, Sequence

import numpy as np

from .archs import Options, Plan
from .bundle import Key
from .checkpoint import Checkpoint
from .errors import Code, ConvertError, Problems, refuse

ALL = "all"
OWN_OPTIONS = ("variant", "gripper_sign", "camera_size", "dataset_info")  # options that may differ between robots


def plan_robots(module: Any, checkpoint: Checkpoint, options: Options, problems: Problems) -> Plan:
    """The plan for all chosen robots; each robot's part equals a conversion for this robot alone. `module`: of the architecture. Errors:
    usage, and those of the module's plans."""
    tags = _tags(module, checkpoint, options)
    if len(tags) == 1:
        return module.plan(checkpoint, options_of(tags[0], tags, options), problems)
    plans = [_plan(module, checkpoint, options_of(tag, tags, options), problems) for tag in tags]
    checkpoint.notes[:] = dict.fromkeys(checkpoint.notes)  # every robot's plan repeats the checkpoint's notes
    return merge(tags, plans)


def _tags(module: Any, checkpoint: Checkpoint, options: Options) -> List[str]:
    if options.embodiment and not hasattr(module, "embodiments"):
        found = "a checkpoint of one robot"
        raise refuse("--embodiment", "a checkpoint of several robots, or of several domains", found, "leave the option out", Code.USAGE)
    tags = module.embodiments(checkpoint) if options.embodiment == ALL else options.embodiment.split(",")
    if len(tags) > 1 and (len(set(tags)) < len(tags) or any("." in tag for tag in tags)):
        raise refuse("--embodiment", "different tags without dots", ",".join(tags), code=Code.USAGE)
    return tags or [""]


def options_of(tag: str, tags: Sequence[str], options: Options) -> Options:
    """The options for converting one of the robots. Errors: usage."""
    own = {name: _value_of(tag, tags, name, getattr(options, name)) for name in OWN_OPTIONS}
    return options.replaced(embodiment=tag, **own)


def _value_of(tag: str, tags: Sequence[str], name: str, given: str) -> str:
    """The robot's value of an option, given as one value for all robots or as TAG=VALUE,... for some. Errors: usage."""
    if given.partition("=")[0] not in tags or "=" not in given:
        return given
    pairs = [part.partition("=") for part in given.split(",")]
    values = {robot: value for robot, _, value in pairs}
    if len(values) < len(pairs) or not all(robot in tags and value for robot, value in values.items()):
        expected = "TAG=VALUE once for each of some of the robots " + ", ".join(tags)
        raise refuse("--" + name.replace("_", "-"), expected, given, code=Code.USAGE)
    return values.get(tag, "")


def _plan(module: Any, checkpoint: Checkpoint, options: Options, problems: Problems) -> Plan:
    """The plan of one of several robots; a refusal names the robot."""
    try:
        return module.plan(checkpoint, options, problems)
    except ConvertError as error:
        named = [p._replace(where="{}: {}".format(options.embodiment, p.where)) for p in error.problems]
        raise ConvertError(named, error.subject)


def merge(tags: Sequence[str], plans: Sequence[Plan]) -> Plan:
    """The plan of a bundle with several robots: a key or tensor that is the same for all robots is stored once."""
    keys = _merged(tags, [{key.name: key for key in plan.keys} for plan in plans])
    weights = _merged(tags, [{weight.target: weight for weight in plan.weights} for plan in plans])
    return Plan(
        [Key("embodiments", "string[]", list(tags)), *(key._replace(name=name) for name, key in keys.items())],
        [weight._replace(target=name) for name, weight in weights.items()],
        plans[0].dropped,
        _merged(tags, [plan.statistics for plan in plans]),
        plans[0].hints,
    )


def _merged(tags: Sequence[str], parts: Sequence[Dict[str, Any]]) -> Dict[str, Any]:
    shared = {name: value for name, value in parts[0].items() if all(_same(part.get(name), value) for part in parts[1:])}
    own = {
        "embodiment.{}.{}".format(tag, name): value for tag, part in zip(tags, parts) for name, value in part.items() if name not in shared
    }
    return {**shared, **own}


def _same(one: Any, other: Any) -> bool:
    if isinstance(other, np.ndarray):
        return isinstance(one, np.ndarray) and one.dtype == other.dtype and np.array_equal(one, other)
    return one == other

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Several robots of a checkpoint in one bundle: what they share is stored once, what is one robot's own under its tag."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Dict, List, Sequence

import numpy as np

from .archs import Options, Plan
from .bundle import Key
from .checkpoint import Checkpoint
from .errors import Code, Problems, refuse

ALL = "all"


def plan_robots(module: Any, checkpoint: Checkpoint, options: Options, problems: Problems) -> Plan:
    """`module`: of the architecture. Each robot's part is what a conversion for it alone writes. Errors: usage, and those of the plans."""
    tags = _tags(module, checkpoint, options)
    if len(tags) == 1:
        return module.plan(checkpoint, replace(options, embodiment=tags[0]), problems)
    variants = options.variant.split(",")
    if len(variants) not in (1, len(tags)):
        expected = "one for all robots, or {} in the order of --embodiment {}".format(len(tags), ",".join(tags))
        raise refuse("--variant", expected, options.variant, code=Code.USAGE)
    plans = [
        module.plan(checkpoint, replace(options, embodiment=tag, variant=variants[i % len(variants)]), problems)
        for i, tag in enumerate(tags)
    ]
    checkpoint.notes[:] = dict.fromkeys(checkpoint.notes)  # each plan makes those of the checkpoint
    return merge(tags, plans)


def _tags(module: Any, checkpoint: Checkpoint, options: Options) -> List[str]:
    tags = module.embodiments(checkpoint) if options.embodiment == ALL else options.embodiment.split(",")
    if len(tags) > 1 and (len(set(tags)) < len(tags) or any("." in tag for tag in tags)):
        raise refuse("--embodiment", "different tags without dots", ",".join(tags), code=Code.USAGE)
    return tags or [""]


def merge(tags: Sequence[str], plans: Sequence[Plan]) -> Plan:
    """A bundle of several robots: a key or tensor that is the same for all of them stands once."""
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
        "embodiment.{}.{}".format(tag, name): value
        for tag, part in zip(tags, parts)
        for name, value in part.items()
        if name not in shared
    }
    return {**shared, **own}


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        return one.dtype == other.dtype and np.array_equal(one, other)
    return one == other

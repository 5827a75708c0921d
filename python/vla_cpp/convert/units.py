# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Units of states and actions, which no checkpoint states: taken from --units and compared with the statistics of the training data."""

from __future__ import annotations

import math
from typing import Dict, List

import numpy as np

from .archs import Plan
from .errors import Code, Problems
from .recipe import ACTION, STATE

UNITS = ("rad", "deg", "m", "cm", "mm", "rad/s", "deg/s", "m/s", "N", "Nm", "A", "%", "1")
NAMES = {STATE: ("observation.state_names", "observation.state_units"), ACTION: ("action.names", "action.units")}
FEW_TURNS = 4 * math.pi  # radians: two turns of a joint
EXTREMES = ("min", "max", "q01", "q99", "q10", "q90", "mean")


def add_units(plan: Plan, given: str, notes: List[str], problems: Problems) -> None:
    """Adds the units to the plan's keys. `given`: UNIT for all numbers, or NAME=UNIT,..., where NAME is a number, or a feature for all of its
    numbers."""
    keys = {key.name: key for key in plan.keys}
    missing = [key for names in NAMES.values() for key in names if key not in keys]
    if missing and given:
        problems.add("--units", "a bundle for one robot", "one for several", "convert each robot alone", Code.USAGE)
    if missing:
        return
    chosen = _parsed(given, problems)
    known = {name for feature, (key, _) in NAMES.items() for name in (feature, *keys[key].value)}
    for name in sorted(set(chosen) - known - {""}):
        problems.add("--units", "one of " + ", ".join(sorted(known)), name, code=Code.USAGE)
    for feature, (names_key, units_key) in NAMES.items():
        units = [chosen.get(name, chosen.get(feature, chosen.get(""))) for name in keys[names_key].value]
        _compare(feature, keys[names_key].value, units, plan.statistics, notes)
        if given:
            plan.keys[plan.keys.index(keys[units_key])] = keys[units_key]._replace(value=[unit or "" for unit in units])


def _parsed(given: str, problems: Problems) -> Dict[str, str]:
    """Units by name; the unit of all numbers has an empty name."""
    chosen: Dict[str, str] = {}
    for part in filter(None, given.split(",")):
        name, _, unit = part.rpartition("=")
        if unit not in UNITS or name in chosen:
            problems.add("--units", "UNIT or NAME=UNIT,... with the units " + ", ".join(UNITS), part, code=Code.USAGE)
        chosen[name] = unit
    return chosen


def _compare(feature: str, names: List[str], units: list, statistics: Dict[str, np.ndarray], notes: List[str]) -> None:
    """Adds notes about implausible units: radians beyond two turns, degrees that reach at most 2 pi, and numbers without a unit that are too
    large for radians."""
    prefix = "stats." + feature + "."
    values = [np.asarray(v) for n, v in statistics.items() if n.startswith(prefix) and n[len(prefix) :] in EXTREMES]
    values = [value.reshape(-1, value.shape[-1]) for value in values if value.ndim and value.shape[-1] >= len(names)]
    if not values:
        return
    reach = np.abs(np.concatenate(values)).max(axis=0)
    for name, unit, far in zip(names, units, reach):
        if unit == "rad" and far > FEW_TURNS:
            notes.append("UNITS: {} is said to be rad, but its training data reach {:.3g}: are these degrees?".format(name, far))
        if unit == "deg" and 0 < far <= 2 * math.pi:
            notes.append("UNITS: {} is said to be deg, but its training data reach only {:.3g}: are these radians?".format(name, far))
    unstated = [name for name, unit, far in zip(names, units, reach) if unit is None and far > FEW_TURNS]
    if unstated:
        notes.append(
            "UNITS: training data of {} reach {:.3g}, which is far for radians and metres: send them as the data set has them, and state "
            "the unit with --units".format(", ".join(unstated[:8]) + (", ..." if unstated[8:] else ""), reach.max())
        )

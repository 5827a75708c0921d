# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Statistics of features: where a checkpoint stores them, which ones a normalization mode reads, and which values are valid.

Reference: lerobot src/lerobot/processor/normalize_processor.py and migrate_policy_normalization.py.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Dict, List, NamedTuple, Sequence, Tuple

import numpy as np

from .checkpoint import Checkpoint, read_statistic
from .errors import Code, Problems
from .safetensors_file import read_safetensors

BUFFER = ".buffer."  # separates data set and feature in a tensor's name
# Normalization mode -> the recipe's kind, and the statistics that its formula reads.
MODES = {
    "IDENTITY": ("identity", ()),
    "MEAN_STD": ("mean_std", ("mean", "std")),
    "MIN_MAX": ("min_max", ("min", "max")),
    "QUANTILES": ("quantiles", ("q01", "q99")),
    "QUANTILE10": ("quantile10", ("q10", "q90")),
}


WIDTHS = "config.json's feature says the first; where that is out of date, --widths statistics follows the statistics"


@dataclass
class Normalization:
    """The normalization of one feature: kind of formula, the reference's epsilon, and statistics by name."""

    kind: str = "identity"
    eps: float = 1e-8
    statistics: Dict[str, np.ndarray] = field(default_factory=dict)

    def op(self, name: str, feature: str) -> List[dict]:
        if self.kind == "identity":
            return []
        return [{"op": name, "kind": self.kind, "stats": "stats." + feature, "eps": self.eps}]


class Found(NamedTuple):
    """Statistics of one feature by name. features: all features with statistics in the same file or group."""

    values: Dict[str, np.ndarray]
    features: List[str]
    robot: str = ""  # the data set that --stats chose


class Context(NamedTuple):
    """Requirements for statistics.

    dims        widths by feature
    identity    features that may be without statistics (--identity-stats)
    degraded    receives the features that have none and stay unnormalized
    min_widths  smallest widths by feature, where statistics may be narrower than the padded width in `dims`
    """

    dims: Dict[str, int]
    identity: Sequence[str]
    notes: List[str]
    degraded: List[str]
    problems: Problems
    min_widths: Dict[str, int]


def choose(feature: str, mode: str, eps: float, found: Found, context: Context) -> Normalization:
    """The normalization of one feature, with checked statistics; the identity if the mode or --identity-stats says so."""
    problems, dim = context.problems, context.dims[feature]
    if not isinstance(mode, str) or mode not in MODES:
        problems.unsupported("normalization of " + feature, " or ".join(MODES), str(mode))
        return Normalization()
    kind, names = MODES[mode]
    if not names:
        return Normalization()
    missing = [name for name in names if name not in found.values]
    own = found.robot and not found.values  # the data set of --stats has no statistics: identity, as in the reference
    if missing and (feature in context.identity or own):
        why = "--stats {} has none".format(found.robot) if own else "--identity-stats allows it"
        context.degraded.append(feature)
        context.notes.append("DEGRADED: {} passes through unchanged: no statistics {}, and {}".format(feature, ", ".join(missing), why))
        return Normalization()
    for name in missing:
        problems.add(
            "statistics of {}: {}".format(feature, name),
            "{} numbers for {}".format(dim, mode),
            "none" + _others(found.features),
            "fine-tune or save the policy with its data set's statistics, or accept unnormalized numbers by --identity-stats " + feature,
        )
    chosen = {name: _plain(found.values[name]) for name in names if name in found.values}
    for name, value in chosen.items():
        widths = (context.min_widths.get(feature, dim), dim)
        _check_statistic("statistics of {}: {}".format(feature, name), name, value, widths, context)
    return Normalization(kind, eps, chosen)


def _plain(value: np.ndarray) -> np.ndarray:
    """The statistic as a vector: those of pixels are stored as (3, 1, 1) to be broadcast over images."""
    return value.ravel() if value.shape == (3, 1, 1) else value


def _others(known: Sequence[str]) -> str:
    return " (there are some for {})".format(", ".join(known)) if known else ""


def _check_statistic(where: str, name: str, value: np.ndarray, widths: Tuple[int, int], context: Context) -> None:
    if value.ndim != 1 or not widths[0] <= value.size <= widths[1]:
        wanted = "shape " + " to ".join("({},)".format(width) for width in sorted(set(widths)))
        context.problems.add(where, wanted, str(value.shape), WIDTHS if value.ndim == 1 and widths[0] == widths[1] else "")
    elif not np.isfinite(value).all():
        context.problems.add(
            where, "finite numbers", str(value[~np.isfinite(value)][0]), "the statistics were never filled in: save the policy again"
        )
    elif name == "std" and (value < 0).any():
        context.problems.add(where, "numbers >= 0", str(value.min()))
    elif name == "std" and (value == 0).any():
        dead = ", ".join(str(i) for i in np.flatnonzero(value == 0))
        context.notes.append("{} is 0 at index {}: the reference divides by 0 + eps there, and so does the recipe".format(where, dead))


def from_file(path: str, feature: str, checkpoint: Checkpoint, problems: Problems) -> Found:
    """Statistics in a processor step's file, named "<feature>.<statistic>". For a policy that was trained on several data sets, LeRobot's
    migration stores "<data set>.buffer.<feature>.<statistic>" per data set, which LeRobot itself does not find."""
    entries = read_safetensors(path).entries
    features = sorted({name.rsplit(".", 1)[0] for name in entries})
    prefix, own = feature + ".", ""
    if checkpoint.robot or feature not in features:
        robots = sorted({name.partition(BUFFER)[0] for name in features if BUFFER in name})
        own = _robot(checkpoint, robots or [""], problems)
        if own and (own + BUFFER + feature in features or feature not in features):
            prefix = own + BUFFER + prefix
    values = {name[len(prefix) :]: read_statistic(entry) for name, entry in entries.items() if name.startswith(prefix)}
    return Found(values, features, checkpoint.robot and own)


def from_weights(checkpoint: Checkpoint, feature: str, problems: Problems) -> Found:
    """Statistics in the older layout, among the weights; groups with the same statistic must agree. A policy that was trained on several
    data sets has "<data set>_buffer_..." per data set, of which LeRobot used the first."""
    marker = "buffer_" + feature.replace(".", "_") + "."
    robots: Dict[str, Dict[str, np.ndarray]] = {}
    for name, entry in sorted(checkpoint.old_statistics.items()):
        _, _, rest = name.partition(".")
        robot, found, statistic = rest.partition(marker)
        if not found or (robot and not robot.endswith("_")):
            continue
        values, value = robots.setdefault(robot[:-1], {}), read_statistic(entry)
        before = values.setdefault(statistic, value)
        if not np.array_equal(before, value, equal_nan=True):
            problems.add("tensor " + name, "the numbers that another group has", "others")
    features = sorted({name.rsplit(".", 1)[0] for name in checkpoint.old_statistics})
    return Found(robots.get(_robot(checkpoint, sorted(robots), problems), {}), features)


def _robot(checkpoint: Checkpoint, robots: List[str], problems: Problems) -> str:
    if checkpoint.robot in robots or len(robots) < 2 and not checkpoint.robot:
        return checkpoint.robot if checkpoint.robot in robots else "".join(robots)
    names = ", ".join(name for name in robots if name) or "none, since the statistics are those of one robot"
    expected = "whose statistics to normalize with: " + names
    if ("--stats", expected) not in [(problem.where, problem.expected) for problem in problems.list]:  # reported once for state and action
        problems.add("--stats", expected, checkpoint.robot or "nothing", code=Code.USAGE)
    return ""

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""States and actions of a robot: the recipe's ops on them, their statistics, and the keys that describe them."""

from __future__ import annotations

from typing import Dict, List, Sequence

import numpy as np

from ... import recipe
from ...bundle import Key
from ...errors import Code, Problems
from ...features import feature_keys
from .. import Options
from .robot import PROCESSOR, STATISTICS, Group, Robot
from .sizes import Sizes


def _total(groups: Sequence[Group]) -> int:
    return sum(group.width for group in groups)


def _op(name: str, feature: str, groups: Sequence[Group]) -> dict:
    kind = "groot_mean_std" if groups[0].mean_std else "groot_min_max"
    return {"op": name, "kind": kind, "stats": "stats." + feature, "eps": 0.0}


def state_ops(robot: Robot, clip_outliers: bool, s: Sizes, problems: Problems) -> List[dict]:
    if _total(robot.states) > s.d_state:
        problems.add(
            STATISTICS + ": state", "at most max_state_dim {} numbers".format(s.d_state), str(_total(robot.states))
        )
    clip = clip_outliers and not robot.states[0].mean_std
    limits = [{"op": "clip", "low": -1.0, "high": 1.0}] if clip else []
    return [_op("normalize", recipe.STATE, robot.states), *limits, {"op": "pad", "size": s.d_state}]


def action_ops(robot: Robot, clip: bool, s: Sizes, problems: Problems) -> List[dict]:
    width = _total(robot.actions)
    if width > s.d_action:
        problems.add(STATISTICS + ": action", "at most max_action_dim {} numbers".format(s.d_action), str(width))
    held = clip and not robot.actions[0].mean_std
    limits = [{"op": "clip", "low": -1.0, "high": 1.0}] if held else []
    ops = [{"op": "rows", "count": robot.n_row}, {"op": "take", "size": width}, *limits]
    columns = _relative_columns(robot, problems)
    added = [{"op": "add_state", "columns": columns}] if columns else []
    return [*ops, _op("unnormalize", recipe.ACTION, robot.actions), *added]


def gripper_ops(robot: Robot, key: str, problems: Problems) -> List[dict]:
    """The sign that a simulator wants of a gripper whose actions count from 0, closed, to 1, open: -sign(2 g - 1)."""
    starts = _starts(robot.actions)
    if key not in starts:
        problems.add("--gripper-sign", "a key of the actions: " + ", ".join(starts), key, code=Code.USAGE)
        return []
    width = next(group.width for group in robot.actions if group.key == key)
    columns = list(range(starts[key], starts[key] + width))
    return [{"op": "threshold", "columns": columns, "above": 0.5, "then": -1.0, "else": 1.0}]


def _starts(groups: Sequence[Group]) -> Dict[str, int]:
    ends = np.cumsum([0, *(group.width for group in groups)])
    return {group.key: int(start) for group, start in zip(groups, ends)}


def _relative_columns(robot: Robot, problems: Problems) -> List[int]:
    """Columns of actions that are relative to the state's number in the same column."""
    actions, states = _starts(robot.actions), _starts(robot.states)
    columns: List[int] = []
    for group in robot.actions:
        if group.reference and states[group.reference] != actions[group.key]:
            expected = "in the columns of the action, from {}".format(actions[group.key])
            hint = "actions relative to other columns of the state are not supported yet"
            problems.unsupported(
                "relative action {}: state {}".format(group.key, group.reference),
                expected,
                str(states[group.reference]),
                hint,
            )
        elif group.reference:
            columns += range(actions[group.key], actions[group.key] + group.width)
    return columns


def _view(key: str) -> str:
    return key if key.startswith("observation.images.") else "observation.images." + key


def _names(groups: Sequence[Group]) -> List[str]:
    return [g.key if g.width == 1 else "{}.{}".format(g.key, i) for g in groups for i in range(g.width)]


def feature_description(robot: Robot, options: Options, notes: List[str], problems: Problems) -> List[Key]:
    """All cameras are needed. Numbers are named by their keys where no data set names them."""
    views, n = [_view(key) for key in robot.cameras], len(robot.cameras)
    if len(set(views)) != n:
        problems.add(PROCESSOR + ": video: modality_keys", "cameras of different names", ", ".join(views))
    dims = {recipe.STATE: _total(robot.states), recipe.ACTION: _total(robot.actions)}
    keys = feature_keys(options.dataset_info, dims, notes if options.dataset_info else [], problems)
    if not options.dataset_info:
        own = {"observation.state_names": _names(robot.states), "action.names": _names(robot.actions)}
        keys = [Key(key.name, key.kind, own.get(key.name, key.value)) for key in keys]
    return [
        Key("observation.views", "string[]", views),
        Key("observation.view_aliases", "string[]", [""] * n),
        Key("observation.view_optional", "u32[]", [0] * n),
        Key("observation.min_views", "u32", n),
        Key("observation.states", "string[]", ["state." + group.key for group in robot.states]),
        Key("observation.state_dims", "u32[]", [group.width for group in robot.states]),
        *keys,
    ]


def statistics_of(feature: str, groups: Sequence[Group]) -> Dict[str, np.ndarray]:
    """Of all keys, one after the other, by the name of the bundle's tensor."""
    names = ("mean", "std") if groups[0].mean_std else ("min", "max")
    columns = ([group.low for group in groups], [group.high for group in groups])
    return {"stats.{}.{}".format(feature, name): np.concatenate(parts) for name, parts in zip(names, columns)}

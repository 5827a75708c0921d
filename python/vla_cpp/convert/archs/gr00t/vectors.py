# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""States and actions of a robot: the recipe's ops on them, their statistics, and the keys that describe them."""

from __future__ import annotations

from typing import Callable, Dict, List, Sequence

import numpy as np

from ... import recipe
from ...bundle import Key
from ...errors import Code, Problems
from ...features import feature_keys, view_name, views_of
from .. import Options
from .robot import BINARY, DEVIATION, PROCESSOR, RANGE, SIN_COS, STATISTICS, Group, Robot
from .sizes import Sizes

# Kind of normalization -> the statistics that it reads.
NAMES = {
    RANGE: ("min", "max"),
    DEVIATION: ("mean", "std"),
    "groot_n1_5_min_max": ("min", "max"),
    "groot_n1_5_quantiles": ("q01", "q99"),
    "groot_n1_5_mean_std": ("mean", "std"),
}

ROTATION_6D = 6  # the first two rows of a rotation's matrix


def _total(groups: Sequence[Group]) -> int:
    return sum(group.width for group in groups)


def _columns(groups: Sequence[Group], holds: Callable[[Group], bool]) -> List[int]:
    starts = _starts(groups)
    return [starts[group.key] + i for group in groups if holds(group) for i in range(group.width)]


def _on(groups: Sequence[Group], holds: Callable[[Group], bool], op: dict) -> List[dict]:
    """The op on the columns of the groups for which `holds` is true; empty if there are none."""
    columns = _columns(groups, holds)
    if not columns:
        return []
    return [op if len(columns) == _total(groups) else {**op, "columns": columns}]


def _normalize(name: str, feature: str, groups: Sequence[Group]) -> List[dict]:
    ops: List[dict] = []
    for kind in NAMES:
        op = {"op": name, "kind": kind, "stats": "stats." + feature, "eps": 0.0}
        ops += _on(groups, lambda group, kind=kind: group.kind == kind, op)
    return ops


def _binary(groups: Sequence[Group]) -> List[dict]:
    columns = _columns(groups, lambda group: group.kind == BINARY)
    return [{"op": "threshold", "columns": columns, "above": 0.5, "then": 1.0, "else": 0.0}] if columns else []


def _rotations(groups: Sequence[Group]) -> List[dict]:
    starts = _starts(groups)
    return [{"op": "rotation", **group.rotation, "column": starts[group.key]} for group in groups if group.rotation]


def _clip(groups: Sequence[Group]) -> List[dict]:
    return _on(groups, lambda group: group.clips, {"op": "clip", "low": -1.0, "high": 1.0})


def state_ops(robot: Robot, s: Sizes, problems: Problems) -> List[dict]:
    turns = _columns(robot.states, lambda group: group.kind == SIN_COS)
    wider = sum(ROTATION_6D - group.width for group in robot.states if group.rotation)
    width, max_width = (_total(robot.states) + len(turns) + wider) // robot.n_moment, s.d_state // s.state_history
    if width > max_width:
        problems.add(STATISTICS + ": state", "at most max_state_dim {} numbers".format(max_width), str(width))
    rows = {"rows": robot.n_moment} if robot.n_moment > 1 else {}
    return [
        *_binary(robot.states),
        *_normalize("normalize", recipe.STATE, robot.states),
        *_clip(robot.states),
        *([{"op": "sin_cos", "columns": turns}] if turns else []),
        *reversed(_rotations(robot.states)),  # from the last: each op shifts the columns after it
        {"op": "pad", "size": s.d_state * s.n_state_row, **rows},
    ]


def action_ops(robot: Robot, s: Sizes, problems: Problems) -> List[dict]:
    width = _total(robot.actions)
    if width > s.d_action:
        problems.add(STATISTICS + ": action", "at most max_action_dim {} numbers".format(s.d_action), str(width))
    return [
        {"op": "rows", "count": robot.n_row},
        {"op": "take", "size": width},
        *_clip(robot.actions),
        *_normalize("unnormalize", recipe.ACTION, robot.actions),
        *_binary(robot.actions),
        *_rotations(robot.actions),
        *_relative_ops(robot),
    ]


def gripper_ops(robot: Robot, key: str, problems: Problems) -> List[dict]:
    """The op that converts a gripper's action g, from 0 (closed) to 1 (open), to the sign that a simulator expects: -sign(2 g - 1)."""
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


def _relative_ops(robot: Robot) -> List[dict]:
    actions, states = _starts(robot.actions), _starts(robot.states)
    columns: List[int] = []
    state_columns: List[int] = []
    poses: List[dict] = []
    for group in robot.actions:
        if not group.reference:
            continue
        start, state = actions[group.key], states.get(group.reference, 0)  # a missing state is reported elsewhere
        if group.pose:
            poses.append({"op": "compose_pose", "format": group.pose, "column": start, "state_column": state})
        else:
            columns += range(start, start + group.width)
            state_columns += range(state, state + group.width)
    others = {} if state_columns == columns else {"state_columns": state_columns}
    return [*([{"op": "add_state", "columns": columns, **others}] if columns else []), *poses]


def _names(groups: Sequence[Group]) -> List[str]:
    return [g.key if g.width == 1 else "{}.{}".format(g.key, i) for g in groups for i in range(g.width)]


def feature_description(robot: Robot, options: Options, notes: List[str], problems: Problems) -> List[Key]:
    """Keys of views, states and actions. All cameras are required. Without a data set, numbers have the names of their keys."""
    views, n = [view_name(key) for key in robot.cameras], len(robot.cameras)
    if len(set(views)) != n:
        problems.add(PROCESSOR + ": video: modality_keys", "cameras of different names", ", ".join(views))
    dims = {recipe.STATE: _total(robot.states), recipe.ACTION: _total(robot.actions)}
    keys = feature_keys(options.dataset_info, dims, notes if options.dataset_info else [], problems)
    if not options.dataset_info:
        own = {"observation.state_names": _names(robot.states), "action.names": _names(robot.actions)}
        keys = [Key(key.name, key.kind, own.get(key.name, key.value)) for key in keys]
    return [
        *views_of(views, [""] * n, [0] * n, n),
        Key("observation.states", "string[]", ["state." + group.key for group in robot.states]),
        Key("observation.state_dims", "u32[]", [group.width for group in robot.states]),
        *keys,
    ]


def statistics_of(feature: str, groups: Sequence[Group]) -> Dict[str, np.ndarray]:
    """Statistics of all keys, concatenated, by the name of the bundle's tensor. A key with another kind of normalization has 0. If a key has
    statistics per action of a chunk, there is a row per action."""
    found: Dict[str, np.ndarray] = {}
    for kind, names in NAMES.items():
        chosen = [group for group in groups if group.kind == kind]
        for name, values in zip(names, ([g.low for g in chosen], [g.high for g in chosen])):
            if not chosen:
                continue
            shape = (*max((value.shape[:-1] for value in values), key=len), _total(groups))
            whole = np.zeros(shape, values[0].dtype)
            starts = _starts(groups)
            for group, value in zip(chosen, values):
                whole[..., starts[group.key] : starts[group.key] + group.width] = value
            found["stats.{}.{}".format(feature, name)] = whole
    return found

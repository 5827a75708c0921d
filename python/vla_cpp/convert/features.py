# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Names of the numbers in states and actions, and the control rate, from a LeRobot data set's meta/info.json if it is given."""

from __future__ import annotations

from typing import Dict, List, Optional, Sequence

from .bundle import Key
from .errors import Problems
from .files import member, read_json
from .recipe import ACTION


def view_name(name: str) -> str:
    return name if name.startswith("observation.images.") else "observation.images." + name


def robot_keys(
    views: List[Key],
    dims: Dict[str, int],
    info_path: str,
    notes: List[str],
    problems: Problems,
    max_tokens: Optional[int] = None,
    states: Optional[Dict[str, int]] = None,
) -> List[Key]:
    """Keys of views, states and actions. `dims`: widths of the data set's vectors. `max_tokens`: most tokens of text, if no other key of the
    plan states it. `states`: widths of the bundle's states, if they differ from the data set's."""
    tokens = [] if max_tokens is None else [Key("observation.max_text_tokens", "u32", max_tokens)]
    return [*views, *states_of(states or dims), *tokens, *feature_keys(info_path, dims, notes, problems)]


def views_of(views: Sequence[str], aliases: Sequence[str], optional: Sequence[int], min_views: int = 1) -> List[Key]:
    return [
        Key("observation.views", "string[]", views),
        Key("observation.view_aliases", "string[]", aliases),
        Key("observation.view_optional", "u32[]", optional),
        Key("observation.min_views", "u32", min_views),
    ]


def states_of(dims: Dict[str, int]) -> List[Key]:
    """Keys of the states. `dims`: widths of vectors; the action is left out."""
    states = {feature: dim for feature, dim in dims.items() if feature != ACTION}
    return [Key("observation.states", "string[]", list(states)), Key("observation.state_dims", "u32[]", list(states.values()))]


def feature_keys(info_path: str, dims: Dict[str, int], notes: List[str], problems: Problems) -> List[Key]:
    """Keys of names and rate. Without a data set, names are generated and the rate is 0, which the runtime treats as unstated."""
    info = read_json(info_path) if info_path else {}
    if info_path:
        _check_info(info, info_path, dims, problems)
    names = {feature: _names(info, info_path, feature, dim, notes, problems) for feature, dim in dims.items()}
    if not info_path:
        notes.append("names of state and action numbers are generated; --dataset-info meta/info.json gives the data set's")
    rate = info.get("fps", 0)
    if not isinstance(rate, (int, float)) or isinstance(rate, bool) or not 0 <= rate < 1e6:
        problems.add(info_path + ": fps", "a rate in Hz", repr(rate))
        rate = 0
    states = [name for feature in dims if feature != ACTION for name in names[feature]]
    return [
        Key("observation.state_names", "string[]", states),
        Key("observation.state_units", "string[]", [""] * len(states)),
        Key("action.names", "string[]", names[ACTION]),
        Key("action.units", "string[]", [""] * dims[ACTION]),
        Key("action.rate_hz", "f32", float(rate)),
    ]


def _check_info(info: dict, path: str, dims: Dict[str, int], problems: Problems) -> None:
    """Checks that the file is a data set's meta/info.json and belongs to this robot."""
    features = member(info, "features", dict, path)
    if not any(feature in features for feature in dims):
        hint = "give meta/info.json of the data set that the policy was trained on"
        problems.add(path + ": features", " and ".join(dims), ", ".join(map(str, features))[:120] or "none", hint)
    for feature, dim in dims.items():
        shape = features[feature].get("shape") if isinstance(features.get(feature), dict) else None
        if shape is not None and shape != [dim]:
            place = "{}: features.{}.shape".format(path, feature)
            problems.add(place, str([dim]), str(shape)[:120], "the data set is not the policy's")


def _names(info: dict, path: str, feature: str, dim: int, notes: List[str], problems: Problems) -> List[str]:
    generated = ["{}.{}".format(feature.rsplit(".", 1)[-1], i) for i in range(dim)]
    stated = _stated_names(member(info, "features", dict, path).get(feature))
    if stated is None:
        if path:
            notes.append("{}: no names for {}, so they are generated".format(path, feature))
        return generated
    if len(stated) != dim or len(set(stated)) != dim or not all(isinstance(name, str) and name for name in stated):
        problems.add(
            "{}: features.{}.names".format(path, feature),
            "{} different names".format(dim),
            str(stated)[:120],
            "the data set is not the policy's",
        )
        return generated
    return stated


def _stated_names(feature) -> Optional[list]:
    """Names of a feature's numbers, or None. Data sets store them as a list, as an object around one list ({"motors": [...]}), or as an
    object from name to index."""
    names = feature.get("names") if isinstance(feature, dict) else None
    if isinstance(names, dict) and names and all(isinstance(index, int) for index in names.values()):
        return sorted(names, key=names.get) if sorted(names.values()) == list(range(len(names))) else list(names.values())
    if isinstance(names, dict) and len(names) == 1:
        names = next(iter(names.values()))
    return names if isinstance(names, list) else None

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""One of the robots of a GR00T checkpoint: its cameras, states, actions and statistics.

Reference: Isaac-GR00T gr00t/data/state_action/state_action_processor.py, gr00t/data/types.py, and lerobot policies/groot/processor_groot.py.
"""

from __future__ import annotations

import os
from typing import Dict, List, NamedTuple, Optional, Sequence, Tuple

import numpy as np

from ...checkpoint import Checkpoint
from ...errors import Code, Problems, refuse
from ...files import member, read_json
from ...options import Option
from ...section import Section

PROCESSOR, STATISTICS, EMBODIMENTS = "processor_config.json", "statistics.json", "embodiment_id.json"
END = "ops behind those of the actions"  # name of an entry in Checkpoint.documents, for LeRobot's checkpoints
DOCS = "docs/converting.md, GR00T"
MODALITY = {"delta_indices", "modality_keys", "sin_cos_embedding_keys", "mean_std_embedding_keys", "action_configs"}
NAMES = {"min", "max", "mean", "std", "q01", "q99"}  # statistics of a key
MAX_WIDTH = 1 << 16
ROBOT_OPTIONS = (  # options of every release
    Option(
        "--embodiment",
        "tag of the robot in processor_config.json; required. A,B,... puts several into one bundle, all every one that has statistics;"
        " --variant, --camera-size, --gripper-sign and --dataset-info then take TAG=VALUE,... where these differ",
        "TAG",
    ),
    Option("--camera-size", "camera resolution, for a pipeline that keeps the aspect ratio; square by default", "WxH"),
    Option(
        "--letterbox",
        "pad images to squares even if the checkpoint does not say so, as the authors' servers have done since March 2026",
        default=False,
    ),
    Option("--gripper-sign", "map the action KEY to -1 above 0.5 and to 1 elsewhere, as LIBERO's simulator expects its gripper", "KEY"),
)


# Kinds of normalization of a key's numbers: a kind of the recipe's ops normalize and unnormalize, one of these two, or "" for none.
SIN_COS, BINARY = "sin_cos", "binary"
RANGE, DEVIATION = "groot_min_max", "groot_mean_std"
POSES = {"XYZ_ROT6D": 9, "XYZ_ROTVEC": 6}  # formats of poses -> number of numbers


class Group(NamedTuple):
    """The numbers of one key of states or actions."""

    key: str
    width: int
    kind: str
    low: np.ndarray  # min, the lower quantile, or mean: (width,), or (row of a chunk, width)
    high: np.ndarray  # max, the upper quantile, or std
    clips: bool = False  # normalized numbers are clipped to [-1, 1]
    reference: str = ""  # for a relative action: key of the state that it is relative to
    pose: str = ""  # for a relative pose: its format
    rotation: Optional[Dict[str, str]] = None  # fields of the op, if the network has the rotation in another representation


class Robot(NamedTuple):
    cameras: List[str]
    states: List[Group]
    actions: List[Group]
    n_row: int  # rows of a chunk that the robot gets
    n_moment: int = 1  # time steps of the state; the groups of each follow those of the previous one


def processor_file(checkpoint: Checkpoint, name: str) -> dict:
    """The JSON file of that name beside the weights or in processor/. Errors: bad_bundle if both exist, io if none does."""
    if name in checkpoint.documents:
        return checkpoint.documents[name]
    places = [place for place in (name, os.path.join("processor", name)) if os.path.exists(checkpoint.path(place))]
    if len(places) > 1:
        raise refuse(checkpoint.folder, "{} once".format(name), " and ".join(places), "remove the one that is not the policy's")
    if not places:
        hint = "it lies beside the weights, or below processor/, of the published checkpoint"
        raise refuse(checkpoint.path(name), "a file", "none", hint, Code.IO)
    return read_json(checkpoint.path(places[0]))


def _keys(config: dict, modality: str) -> List[str]:
    part = config.get(modality) if isinstance(config, dict) else None
    keys = part.get("modality_keys") if isinstance(part, dict) else None
    return [key for key in keys if isinstance(key, str)] if isinstance(keys, list) else []


def choose(configs: dict, tag: str) -> dict:
    """The modalities of a tag. Errors: usage, listing the tags."""
    if tag in configs and isinstance(configs[tag], dict):
        return configs[tag]
    listed = "; ".join("{} (cameras {})".format(name, ", ".join(_keys(value, "video")) or "none") for name, value in configs.items())
    raise refuse(
        "--embodiment",
        "the tag of the robot, one of: " + (listed or "none, since {} lists no robots".format(PROCESSOR)),
        tag or "none",
        "the checkpoint holds several robots with weights, cameras and statistics of their own ({})".format(DOCS),
        Code.USAGE,
    )


def embodiment_index(checkpoint: Checkpoint, tag: str, built_in: Dict[str, int], n_embodiment: int, problems: Problems) -> int:
    """The tag's index in the weights. `built_in`: the authors' indices of tags that are missing in embodiment_id.json."""
    stated = processor_file(checkpoint, EMBODIMENTS)
    if tag not in stated and tag in built_in:
        checkpoint.notes.append("{} has no {}: index {}, as in the authors' table".format(EMBODIMENTS, tag, built_in[tag]))
    index = stated.get(tag, built_in.get(tag))
    if type(index) is int and 0 <= index < n_embodiment:
        return index
    problems.add("{}: {}".format(EMBODIMENTS, tag), "an index below max_num_embodiments {}".format(n_embodiment), str(index))
    return 0


def check_widths(where: str, stated: dict, names: Sequence[str], width: int, problems: Problems) -> None:
    """Checks the width of a key's unused statistics, since LeRobot takes the key's width from the mean. They may have a row per action."""
    for name in sorted(NAMES.intersection(stated) - set(names)):
        values = stated[name]
        row = values[0] if isinstance(values, list) and values and isinstance(values[0], list) else values
        if not isinstance(row, list) or len(row) != width:
            problems.add("{}.{}".format(where, name), "as many numbers as {}: {}".format(names[0], width), str(values)[:80])


class _Reader:
    def __init__(self, tag: str, config: dict, statistics: dict, processor: Section, problems: Problems) -> None:
        self.tag, self.config, self.problems, self.processor = tag, config, problems, processor
        self.percentiles, self.relative = processor.get("use_percentiles"), processor.get("use_relative_action")
        self.clips, self.sin_cos = processor.get("clip_outliers"), processor.get("apply_sincos_state_encoding")
        self.statistics = member(statistics, tag, dict, STATISTICS)
        if tag not in statistics:
            problems.add("{}: {}".format(STATISTICS, tag), "statistics", "none", "the checkpoint was not trained for this robot")

    def modality(self, name: str) -> Section:
        where = "{}: {}.{}".format(PROCESSOR, self.tag, name)
        section = Section(where, member(self.config, name, dict, where), {}, self.problems)
        for key, value in sorted(section.values.items()):
            if key not in MODALITY and value not in (None, False):
                section.bad(key, "a key that this converter knows", hint="it may change numbers", unsupported=True)
        keys = section.get("modality_keys")
        if not isinstance(keys, list) or not keys or not all(isinstance(k, str) and k for k in keys) or len(set(keys)) != len(keys):
            section.bad("modality_keys", "different names")
            section.values = {**section.values, "modality_keys": []}
        return section

    def listed(self, section: Section, name: str) -> List[str]:
        return [key for key in member(section.values, name, list, section.where) if isinstance(key, str)]

    def statistic(self, part: str, key: str, names: Tuple[str, str], n_row: int = 0) -> List[np.ndarray]:
        """Two statistics of a key. `n_row`: their least number of rows, if they have one row per action of a chunk."""
        where = "{}: {}.{}.{}".format(STATISTICS, self.tag, part, key)
        stated = member(member(self.statistics, part, dict, where), key, dict, where)
        found = [self.numbers("{}.{}".format(where, name), stated.get(name), n_row) for name in names]
        if found[0].shape != found[1].shape:
            self.problems.add(where, "statistics of one shape", "{} and {}".format(*(x.shape for x in found)))
            found[1] = found[0]
        check_widths(where, stated, names, found[0].shape[-1], self.problems)
        if names == ("mean", "std") and (found[1] < 0).any():
            self.problems.add(where + ".std", "numbers >= 0", str(found[1].min()))
        return found

    def numbers(self, where: str, values, n_row: int) -> np.ndarray:
        nested = n_row > 0 and isinstance(values, list) and any(isinstance(row, list) for row in values)
        rows = values if nested else [values]
        sound = all(
            isinstance(row, list) and row and len(row) == len(rows[0]) and all(type(v) in (int, float) for v in row) for row in rows
        )
        if not sound or len(rows[0]) > MAX_WIDTH:
            self.problems.add(where, "numbers", "none" if not values else str(values)[:80])
            return np.zeros(1)
        if nested and len(rows) < n_row:
            self.problems.add(where, "a row for each of {} actions".format(n_row), "{} rows".format(len(rows)))
        with np.errstate(over="ignore"):  # reported below
            fits = np.isfinite(np.asarray(rows, np.float64).astype(np.float32))
        if not fits.all():
            self.problems.add(where, "numbers that float32 holds", str(np.asarray(rows)[~fits][0]))
        return np.asarray(rows[:n_row] if nested else rows[0], np.float64)

    def range_names(self) -> Tuple[str, str]:
        return ("q01", "q99") if self.percentiles else ("min", "max")

    def states(self) -> List[Group]:
        section = self.modality("state")
        suffixes = [moment_suffix(t) for t in moments(section)]
        mean_std = self.listed(section, "mean_std_embedding_keys")
        turns = self.listed(section, "sin_cos_embedding_keys") if self.sin_cos else []
        groups = []
        for key in section.get("modality_keys"):
            kind = SIN_COS if key in turns else DEVIATION if key in mean_std else RANGE
            low, high = self.statistic("state", key, ("mean", "std") if kind == DEVIATION else self.range_names())
            if kind == RANGE:  # the reference normalizes to 0 if the two are close relative to their size
                high = np.where(np.isclose(high, low), low, high)
            groups.append(Group(key, low.size, kind, low, high, kind == RANGE and self.clips))
        # Each moment's state has its own key. The suffix of the current moment is empty, so relative actions find it by the plain key.
        return [group._replace(key=group.key + suffix) for suffix in suffixes for group in groups]

    def actions(self, states: Sequence[Group], n_row: int) -> List[Group]:
        section = self.modality("action")
        configs = member(section.values, "action_configs", list, section.where)
        keys, mean_std = section.get("modality_keys"), self.listed(section, "mean_std_embedding_keys")
        if not configs:  # null: all actions are absolute
            configs = [{"rep": "ABSOLUTE"}] * len(keys)
        if len(configs) != len(keys) or not all(isinstance(config, dict) for config in configs):
            section.bad("action_configs", "a JSON object for each of {} keys".format(len(keys)), str(configs)[:80])
            return []
        widths = {state.key: state.width for state in states}
        groups = []
        for i, key in enumerate(keys):
            how = Section("{}: action_configs[{}] ({})".format(section.where, i, key), configs[i], {}, self.problems)
            kind, names = (DEVIATION, ("mean", "std")) if key in mean_std else (RANGE, self.range_names())
            low, high = self.statistic("action", key, names)
            group = Group(key, low.size, kind, low, high, kind == RANGE)
            groups.append(self.relative_group(group, how, widths, n_row) if self.is_relative(how) else group)
        return groups

    def relative_group(self, group: Group, how: Section, widths: Dict[str, int], n_row: int) -> Group:
        """The group of a relative action, with the statistics of its relative values, which are never percentiles. `widths`: of the states."""
        reference = str(how.get("state_key") or group.key) + moment_suffix(moments(self.modality("state"))[-1])
        pose = self.pose(how, group.width)
        names = ("mean", "std") if group.kind == DEVIATION else ("min", "max")
        low, high = self.statistic("relative_action", group.key, names, n_row)
        if low.shape[-1] != group.width:
            where = "{}: {}.relative_action.{}".format(STATISTICS, self.tag, group.key)
            self.problems.add(where, "{} numbers".format(group.width), str(low.shape[-1]))
        if widths.get(reference) != group.width:
            found = "none" if reference not in widths else "{} numbers".format(widths[reference])
            how.bad("state_key", "a state of {} numbers".format(group.width), found)
        return group._replace(low=low, high=high, reference=reference, pose=pose)

    def is_relative(self, how: Section) -> bool:
        for key in sorted(set(how.values) - {"rep", "type", "format", "state_key"}):
            how.bad(key, "a key that this converter knows", unsupported=True)
        rep = how.get("rep")
        if rep not in ("ABSOLUTE", "DELTA", "RELATIVE"):
            how.bad("rep", "ABSOLUTE, DELTA or RELATIVE", unsupported=True)
        return rep == "RELATIVE" and bool(self.relative)

    def pose(self, how: Section, width: int) -> str:
        """The format of a relative pose; "" if the numbers are added elementwise."""
        kind, pose = how.get("type"), how.get("format")
        if kind == "NON_EEF":
            if pose != "DEFAULT":
                how.bad("format", "DEFAULT, since the type is NON_EEF", unsupported=True)
            return ""
        if kind != "EEF":
            how.bad("type", "EEF or NON_EEF", unsupported=True)
        elif pose not in POSES:
            how.bad("format", " or ".join(POSES), unsupported=True)
        elif POSES[pose] != width:
            how.bad("format", "a key of {} numbers".format(POSES[pose]), "{} of {}".format(pose, width))
        return str(pose).lower()


def moments(section: Section) -> List[int]:
    """The times of frames or states, in control steps relative to the current one (0 or negative)."""
    steps = section.get("delta_indices")
    sound = isinstance(steps, list) and steps and all(type(t) is int and -1000 <= t <= 0 for t in steps)
    if sound and sorted(set(steps)) == steps:
        return steps
    section.bad("delta_indices", "rising numbers of steps from -1000 to 0")
    return [0]


def moment_suffix(step: int) -> str:
    """The suffix of a feature's name: a frame or state of 15 steps ago is the separate feature name@-15."""
    return "@{}".format(step) if step else ""


def views(video: Section) -> List[str]:
    """Names of every camera at every moment: moments in the order of `delta_indices`, and within each the cameras."""
    return [key + moment_suffix(t) for t in moments(video) for key in video.get("modality_keys")]


def read_robot(tag: str, config: dict, statistics: dict, processor: Section, horizon: int, problems: Problems) -> Robot:
    """Reads a robot. `processor`: the members of processor_kwargs. `horizon`: rows of the network's chunk, of which the robot gets the first."""
    reader = _Reader(tag, config, statistics, processor, problems)
    video = reader.modality("video")
    cameras = views(video)
    steps = reader.modality("action").get("delta_indices")
    if not isinstance(steps, list) or not steps:
        problems.add("{}: {}.action: delta_indices".format(PROCESSOR, tag), "a list of steps", repr(steps)[:80])
        steps = [0]
    n_row, states = min(len(steps), horizon), reader.states()
    return Robot(cameras, states, reader.actions(states, n_row), n_row, len(moments(reader.modality("state"))))

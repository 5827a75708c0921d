# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""One of the robots of a GR00T checkpoint: its cameras, states, actions and statistics.

Reference: Isaac-GR00T gr00t/data/state_action/state_action_processor.py, gr00t/data/types.py, and lerobot policies/groot/processor_groot.py.
"""

from __future__ import annotations

import os
from typing import Dict, List, NamedTuple, Sequence

import numpy as np

from ...checkpoint import Checkpoint
from ...errors import Code, Problems, refuse
from ...files import member, read_json
from ...section import Section

PROCESSOR, STATISTICS, EMBODIMENTS = "processor_config.json", "statistics.json", "embodiment_id.json"
DOCS = "docs/converting.md, GR00T"
MODALITY = {"delta_indices", "modality_keys", "sin_cos_embedding_keys", "mean_std_embedding_keys", "action_configs"}
MAX_WIDTH = 1 << 16


class Group(NamedTuple):
    """The numbers that stand under one key of states or actions."""

    key: str
    width: int
    low: np.ndarray  # min, the lower quantile, or mean
    high: np.ndarray  # max, the upper quantile, or std
    mean_std: bool = False
    reference: str = ""  # of a relative action: the state's key that it is added to


class Robot(NamedTuple):
    cameras: List[str]
    states: List[Group]
    actions: List[Group]
    n_row: int  # actions of a chunk that are meant for this robot
    clips: bool = False  # states are held between -1 and 1


def processor_file(checkpoint: Checkpoint, name: str) -> str:
    """Beside the weights or below processor/. Errors: bad_bundle where both exist, io where none does."""
    places = [place for place in (name, os.path.join("processor", name)) if os.path.exists(checkpoint.path(place))]
    if len(places) > 1:
        raise refuse(
            checkpoint.folder, "{} once".format(name), " and ".join(places), "remove the one that is not the policy's"
        )
    if not places:
        hint = "it lies beside the weights, or below processor/, of the published checkpoint"
        raise refuse(checkpoint.path(name), "a file", "none", hint, Code.IO)
    return checkpoint.path(places[0])


def _keys(config: dict, modality: str) -> List[str]:
    part = config.get(modality) if isinstance(config, dict) else None
    keys = part.get("modality_keys") if isinstance(part, dict) else None
    return [key for key in keys if isinstance(key, str)] if isinstance(keys, list) else []


def choose(configs: dict, tag: str) -> dict:
    """The modalities of a tag. Errors: usage, with the tags that there are."""
    if tag in configs and isinstance(configs[tag], dict):
        return configs[tag]
    listed = "; ".join(
        "{} (cameras {})".format(name, ", ".join(_keys(value, "video")) or "none") for name, value in configs.items()
    )
    raise refuse(
        "--embodiment",
        "the tag of the robot, one of: " + (listed or "none, since {} lists no robots".format(PROCESSOR)),
        tag or "none",
        "the checkpoint holds several robots with weights, cameras and statistics of their own ({})".format(DOCS),
        Code.USAGE,
    )


def embodiment_index(
    checkpoint: Checkpoint, tag: str, built_in: Dict[str, int], n_embodiment: int, problems: Problems
) -> int:
    """The row of the weights that belongs to a tag. `built_in`: what the authors' processor gives to tags that
    embodiment_id.json does not have."""
    stated = read_json(processor_file(checkpoint, EMBODIMENTS))
    if tag not in stated and tag in built_in:
        checkpoint.notes.append(
            "{} has no {}: index {}, as in the authors' table".format(EMBODIMENTS, tag, built_in[tag])
        )
    index = stated.get(tag, built_in.get(tag))
    if type(index) is int and 0 <= index < n_embodiment:
        return index
    problems.add(
        "{}: {}".format(EMBODIMENTS, tag), "an index below max_num_embodiments {}".format(n_embodiment), str(index)
    )
    return 0


class _Reader:
    def __init__(self, tag: str, config: dict, statistics: dict, processor: Section, problems: Problems) -> None:
        self.tag, self.config, self.problems, self.processor = tag, config, problems, processor
        self.percentiles, self.relative = processor.get("use_percentiles"), processor.get("use_relative_action")
        self.statistics = member(statistics, tag, dict, STATISTICS)
        if tag not in statistics:
            problems.add(
                "{}: {}".format(STATISTICS, tag), "statistics", "none", "the checkpoint was not trained for this robot"
            )

    def modality(self, name: str) -> Section:
        where = "{}: {}.{}".format(PROCESSOR, self.tag, name)
        section = Section(where, member(self.config, name, dict, where), {}, self.problems)
        for key, value in sorted(section.values.items()):
            if key not in MODALITY and value not in (None, False):
                section.bad(key, "a key that this converter knows", hint="it may change numbers", unsupported=True)
        keys = section.get("modality_keys")
        if (
            not isinstance(keys, list)
            or not keys
            or not all(isinstance(k, str) and k for k in keys)
            or len(set(keys)) != len(keys)
        ):
            section.bad("modality_keys", "different names")
            section.values = {**section.values, "modality_keys": []}
        return section

    def one_step(self, section: Section, what: str) -> None:
        if section.get("delta_indices") != [0]:
            section.bad(
                "delta_indices",
                "[0]",
                hint="{} of several moments are not supported yet".format(what),
                unsupported=True,
            )

    def listed(self, section: Section, name: str) -> List[str]:
        return [key for key in member(section.values, name, list, section.where) if isinstance(key, str)]

    def group(self, kind: str, key: str, mean_std: bool, reference: str = "", width: int = 0) -> Group:
        """`width`: of the same key's absolute actions, where these statistics are of relative ones."""
        names = (
            ("mean", "std") if mean_std else ("q01", "q99") if self.percentiles and not reference else ("min", "max")
        )
        where = "{}: {}.{}.{}".format(STATISTICS, self.tag, kind, key)
        stated = member(member(self.statistics, kind, dict, where), key, dict, where)
        if self.per_step(where, stated.get(names[0])):
            return Group(key, width, np.zeros(width, np.float32), np.ones(width, np.float32))
        low, high = (self.numbers("{}.{}".format(where, name), stated.get(name)) for name in names)
        if low.size != high.size or (width and low.size != width):
            self.problems.add(where, "{} numbers".format(width or low.size), "{} and {}".format(low.size, high.size))
            high = low
        if mean_std and (high < 0).any():
            self.problems.add(where + ".std", "numbers >= 0", str(high.min()))
        return Group(key, low.size, low, high, mean_std, reference)

    def per_step(self, where: str, values) -> bool:
        nested = isinstance(values, list) and any(isinstance(value, list) for value in values)
        if nested:
            hint = "ranges of their own for each step of a chunk are not supported yet"
            self.problems.unsupported(where, "a number for each column", "{} rows".format(len(values)), hint)
        return nested

    def numbers(self, where: str, values) -> np.ndarray:
        numbers = isinstance(values, list) and all(
            isinstance(v, (int, float)) and not isinstance(v, bool) for v in values
        )
        if not numbers or not 1 <= len(values) <= MAX_WIDTH:
            self.problems.add(where, "numbers", "none" if not values else str(values)[:80])
            return np.zeros(1, np.float32)
        with np.errstate(over="ignore"):  # told below
            chosen = np.asarray(values, np.float64).astype(np.float32)
        if not np.isfinite(chosen).all():
            self.problems.add(where, "finite numbers", str(chosen[~np.isfinite(chosen)][0]))
        return chosen

    def states(self) -> List[Group]:
        section = self.modality("state")
        self.one_step(section, "states")
        if self.processor.get("apply_sincos_state_encoding") and self.listed(section, "sin_cos_embedding_keys"):
            section.bad(
                "sin_cos_embedding_keys",
                "none",
                hint="sines and cosines of states are not supported yet",
                unsupported=True,
            )
        mean_std = self.listed(section, "mean_std_embedding_keys")
        groups = [self.group("state", key, key in mean_std) for key in section.get("modality_keys")]
        self.check_one_kind(section, groups)
        return groups

    def check_one_kind(self, section: Section, groups: Sequence[Group]) -> None:
        if len({group.mean_std for group in groups}) > 1:
            hint = "ranges for some keys and standard deviations for others are not supported yet"
            section.bad("mean_std_embedding_keys", "all keys or none", hint=hint, unsupported=True)

    def actions(self, states: Sequence[Group]) -> List[Group]:
        section = self.modality("action")
        configs = member(section.values, "action_configs", list, section.where)
        keys, mean_std = section.get("modality_keys"), self.listed(section, "mean_std_embedding_keys")
        if not configs:  # null: all of them absolute
            configs = [{"rep": "ABSOLUTE"}] * len(keys)
        if len(configs) != len(keys) or not all(isinstance(config, dict) for config in configs):
            section.bad("action_configs", "a JSON object for each of {} keys".format(len(keys)), str(configs)[:80])
            return []
        widths = {state.key: state.width for state in states}
        groups = []
        for i, key in enumerate(keys):
            how = Section("{}: action_configs[{}] ({})".format(section.where, i, key), configs[i], {}, self.problems)
            group = self.group("action", key, key in mean_std)
            if self.is_relative(how, key in mean_std):
                reference = str(how.get("state_key") or key)
                group = self.group("relative_action", key, False, reference, group.width)
                if widths.get(reference) != group.width:
                    found = "none" if reference not in widths else "{} numbers".format(widths[reference])
                    how.bad("state_key", "a state of {} numbers".format(group.width), found)
            groups.append(group)
        self.check_one_kind(section, groups)
        return groups

    def is_relative(self, how: Section, mean_std: bool) -> bool:
        for key in sorted(set(how.values) - {"rep", "type", "format", "state_key"}):
            how.bad(key, "a key that this converter knows", unsupported=True)
        rep, kind = how.get("rep"), how.get("type")
        if rep not in ("ABSOLUTE", "DELTA", "RELATIVE"):
            how.bad("rep", "ABSOLUTE, DELTA or RELATIVE", unsupported=True)
        if rep != "RELATIVE" or not self.relative:
            return False
        if kind != "NON_EEF":
            how.bad(
                "type", "NON_EEF", hint="poses relative to the end effector's are not supported yet", unsupported=True
            )
        if mean_std:
            how.bad("rep", "ABSOLUTE where mean_std_embedding_keys names the key", unsupported=True)
        return True


def views(video: Section) -> List[str]:
    """Every camera at every moment, the moments in the order of `delta_indices` and in each the cameras: a frame that was taken 15 steps
    ago is a view of its own, camera@-15."""
    moments = video.get("delta_indices")
    sound = isinstance(moments, list) and moments and all(type(t) is int and -1000 <= t <= 0 for t in moments)
    if not sound or sorted(set(moments)) != moments:
        video.bad("delta_indices", "rising numbers of steps from -1000 to 0")
        moments = [0]
    return ["{}@{}".format(key, t) if t else key for t in moments for key in video.get("modality_keys")]


def read_robot(tag: str, config: dict, statistics: dict, processor: Section, horizon: int, problems: Problems) -> Robot:
    """`processor`: the members of processor_kwargs. `horizon`: rows of the network's chunk, of which the first are the robot's."""
    reader = _Reader(tag, config, statistics, processor, problems)
    video = reader.modality("video")
    cameras = views(video)
    states = reader.states()
    actions = reader.actions(states)
    steps = reader.modality("action").get("delta_indices")
    if not isinstance(steps, list) or not steps:
        problems.add("{}: {}.action: delta_indices".format(PROCESSOR, tag), "a list of steps", repr(steps)[:80])
        steps = [0]
    return Robot(cameras, states, actions, min(len(steps), horizon))

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""LeRobot's pre- and post-processors as recipe operations.

Every step and every field is either translated or refused: skipping a step would change numbers.
Reference: lerobot src/lerobot/processor (normalize_processor.py, tokenizer_processor.py, rename_processor.py, pipeline.py).
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Dict, List, Mapping, Optional, Sequence

import numpy as np

from .bundle import Key
from .checkpoint import Checkpoint
from .errors import Code, ConvertError, Problems
from .files import member, plain_name
from .normalization import MODES, Context, Found, Normalization, choose, from_file, from_weights

STATE, ACTION = "observation.state", "action"
MAX_TOKENS = 1 << 16  # tokens; far above any instruction
PRE, POST = "policy_preprocessor.json", "policy_postprocessor.json"

# Fields of each step that this converter knows, with their permitted values: a tuple lists the values with which the recipe is exact.
# An architecture adds its own steps.
ANY = object()
Steps = Dict[str, Dict[str, Dict[str, object]]]
DEVICE = {"device": ANY, "float_dtype": (None, "float32", "float")}
NORMALIZER = {"eps": ANY, "features": ANY, "norm_map": ANY, "normalize_observation_keys": ANY}
STEPS: Steps = {
    PRE: {
        "rename_observations_processor": {"rename_map": ANY},
        "to_batch_processor": {},
        "tokenizer_processor": {
            "max_length": ANY,
            "task_key": ("task",),
            "padding_side": ("right",),
            "truncation": (True,),
            "padding": ("max_length", "longest", True, False, "do_not_pad"),
            "tokenizer_name": ANY,
        },
        "device_processor": DEVICE,
        "normalizer_processor": NORMALIZER,
    },
    POST: {"unnormalizer_processor": NORMALIZER, "device_processor": DEVICE},
}


RELATIVE: Steps = {  # steps of policies that may have learned actions relative to the state
    PRE: {"relative_actions_processor": {"enabled": (True, False), "exclude_joints": ANY, "action_names": ANY}},
    POST: {"absolute_actions_processor": {"enabled": (True, False)}},
}


@dataclass
class Processors:
    """The contents of the two pipelines, independent of their format."""

    rename: Dict[str, str] = field(default_factory=dict)  # accepted name -> the policy's name
    newline: bool = False
    discrete_state: bool = False  # the discretized state is part of the prompt
    relative: bool = False  # actions are relative to the state
    add_state: Sequence[int] = ()  # columns of relative actions
    max_tokens: int = 0
    own_tokenizer: str = ""  # folder of the tokenizer inside the checkpoint
    state: Normalization = field(default_factory=Normalization)
    action: Normalization = field(default_factory=Normalization)
    others: Dict[str, Normalization] = field(default_factory=dict)  # by further feature of the observation

    def statistics(self, without: Sequence[str] = ()) -> Dict[str, np.ndarray]:
        """Statistics by the name of the bundle's tensor. `without`: features whose statistics the bundle does not store as tensors."""
        known = ((STATE, self.state), (ACTION, self.action), *self.others.items())
        return {"stats.{}.{}".format(f, name): v for f, norm in known if f not in without for name, v in norm.statistics.items()}


class _Reader:
    """Reads both pipelines and collects everything that it cannot translate."""

    def __init__(
        self,
        checkpoint: Checkpoint,
        dims: Dict[str, int],
        identity: Sequence[str],
        problems: Problems,
        own: Steps,
        min_widths: Dict[str, int],
        others: Mapping[str, str],
    ) -> None:
        self.others = others
        self.steps = {file: {**STEPS[file], **own.get(file, {})} for file in STEPS}
        self.checkpoint, self.problems, self.result = checkpoint, problems, Processors()
        self.context = Context(dims, identity, checkpoint.notes, checkpoint.degraded, problems, min_widths)
        self.seen: List[str] = []

    def pipeline(self, file: str, content: dict) -> None:
        steps = content.get("steps")
        for key in sorted(set(content) - {"name", "steps"}):
            self.problems.unsupported("{}: {}".format(file, key), "name and steps only", "the field " + key)
        if not isinstance(steps, list):
            self.problems.add(file + ": steps", "a list of steps", type(steps).__name__)
            return
        self.seen = []
        for i, step in enumerate(steps):
            self.step(file, "{}: steps[{}]".format(file, i), step)

    def step(self, file: str, where: str, step) -> None:
        name = step.get("registry_name", step.get("class")) if isinstance(step, dict) else None
        known = self.steps[file].get(name) if isinstance(name, str) else None
        if known is None:
            self.problems.unsupported(
                where,
                "one of " + ", ".join(self.steps[file]),
                str(name),
                "this step changes what the policy sees or returns, and the recipe has no operation for it",
            )
            return
        where += " " + name
        if name in self.seen and name != "device_processor":
            self.problems.unsupported(where, "the step once", "the step a second time")
        self.seen.append(name)
        config = step.get("config", {})
        extra = sorted(set(step) - {"registry_name", "config", "state_file", "artifacts"})
        extra += sorted(set(config) - set(known)) if isinstance(config, dict) else ["config"]
        for key in extra:
            self.problems.unsupported("{}: {}".format(where, key), "no such field", str(step.get(key, config))[:80])
        if extra:
            return
        for key, allowed in known.items():
            if allowed is not ANY and key in config and config[key] not in allowed:
                self.problems.unsupported("{}: {}".format(where, key), " or ".join(map(repr, allowed)), repr(config[key]))
        handler = getattr(self, "_" + name.replace("_processor", ""), None)
        if handler:
            handler(where, config, step)

    def _rename_observations(self, where: str, config: dict, step: dict) -> None:
        if "normalizer_processor" in self.seen:
            self.problems.unsupported(where, "renaming before normalization", "the opposite order")
        names = config.get("rename_map", {})
        if not isinstance(names, dict) or not all(isinstance(v, str) for v in names.values()):
            self.problems.add(where + ": rename_map", "names with names", str(names)[:80])
            return
        self.result.rename = {old: new for old, new in names.items() if old != new}

    def _smolvla_new_line(self, where: str, config: dict, step: dict) -> None:
        if "tokenizer_processor" in self.seen:
            self.problems.unsupported(where, "the newline before tokenization", "the opposite order")
        self.result.newline = True

    _pi0_new_line = _smolvla_new_line

    def _pi05_prepare_state_tokenizer_step(self, where: str, config: dict, step: dict) -> None:
        if "tokenizer_processor" in self.seen or "normalizer_processor" not in self.seen:
            self.problems.unsupported(where, "normalization before it and tokenization after it", "another order")
        self.result.discrete_state = True

    _pi0_fast_prepare_state_tokenizer_step = _pi05_prepare_state_tokenizer_step

    def _relative_actions(self, where: str, config: dict, step: dict) -> None:
        if "normalizer_processor" in self.seen:
            self.problems.unsupported(where, "the state of the robot, before normalization", "the opposite order")
        if config.get("enabled", False) is not True:
            return
        self.result.relative = True
        exclude = member(config, "exclude_joints", list, where)
        names = config.get("action_names")
        width = self.context.dims[ACTION]
        if names is not None and (not isinstance(names, list) or not all(isinstance(name, str) for name in names)):
            self.problems.add(where + ": action_names", "names of the action's numbers", str(names)[:80])
            return
        self.result.add_state = relative_columns(width, names, [str(name).lower() for name in exclude if name])
        n_state = self.context.dims.get(STATE, 0)
        if width > n_state:
            self.problems.unsupported(where, "a state with a number for each of the {} actions".format(width), str(n_state))

    def _absolute_actions(self, where: str, config: dict, step: dict) -> None:
        if "unnormalizer_processor" not in self.seen:
            self.problems.unsupported(where, "un-normalization before it", "the opposite order")
        if bool(config.get("enabled", False)) != self.result.relative:
            self.problems.add(
                where + ": enabled", "{} as the relative_actions_processor has it".format(self.result.relative), str(config.get("enabled"))
            )

    def _tokenizer(self, where: str, config: dict, step: dict) -> None:
        self.result.max_tokens = self.token_count(where + ": max_length", config.get("max_length", 512))
        folder = member(step, "artifacts", dict, where).get("tokenizer_name", "")
        if folder and not plain_name(folder):
            self.problems.add(where + ": artifacts", "a folder inside the checkpoint", repr(folder))
        elif folder:
            self.result.own_tokenizer = folder

    def token_count(self, where: str, length) -> int:
        if isinstance(length, int) and not isinstance(length, bool) and 0 < length <= MAX_TOKENS:
            return length
        self.problems.add(where, "a count of tokens from 1 to {}".format(MAX_TOKENS), repr(length))
        return 1

    def _normalizer(self, where: str, config: dict, step: dict) -> None:
        keys = member(config, "normalize_observation_keys", list, where)
        if STATE in self.context.dims:
            self._state(where, config, step)
        for feature, kind in self.others.items():
            if config.get("normalize_observation_keys") is not None and feature not in keys:
                self.problems.unsupported(where + ": normalize_observation_keys", feature + " among them", str(keys)[:80])
            self.result.others[feature] = self.normalization(where, config, step, feature, kind)

    def _state(self, where: str, config: dict, step: dict) -> None:
        keys = member(config, "normalize_observation_keys", list, where)
        if config.get("normalize_observation_keys") is not None and STATE not in keys:
            self.problems.unsupported(where + ": normalize_observation_keys", STATE + " among them", str(keys)[:80])
        features = member(config, "features", dict, where)
        stated = member(features, STATE, dict, where + ": features")
        width = self.context.dims[STATE]
        listed = member(member(self.checkpoint.config, "input_features", dict, "config.json"), STATE, dict, "config.json: input_features")
        widths = ([width], [self.context.min_widths.get(STATE, width)], listed.get("shape"))
        of_base = not features and step.get("state_file") is None  # LeRobot publishes base policies without statistics
        if not of_base and (stated.get("shape") not in widths or stated.get("type") != "STATE"):
            self.problems.add("{}: features.{}".format(where, STATE), "STATE of [{}] as in config.json".format(width), str(stated)[:80])
        self.result.state = self.normalization(where, config, step, STATE, "STATE")

    def _unnormalizer(self, where: str, config: dict, step: dict) -> None:
        self.result.action = self.normalization(where, config, step, ACTION, "ACTION")

    def normalization(self, where: str, config: dict, step: dict, feature: str, kind: str) -> Normalization:
        modes = member(config, "norm_map", dict, where)
        if modes.get("VISUAL", "IDENTITY") != "IDENTITY" and not self.normalizes_pixels():
            self.problems.unsupported(
                where + ": norm_map.VISUAL", "IDENTITY", str(modes["VISUAL"]), "the recipe does not normalize pixels by statistics"
            )
        stated = member(self.checkpoint.config, "normalization_mapping", dict, "config.json")
        for key in (kind, "VISUAL"):
            if stated.get(key, modes.get(key)) != modes.get(key):
                self.problems.add("{}: norm_map.{}".format(where, key), "{} as in config.json".format(stated[key]), str(modes.get(key)))
        found = Found({}, [])
        if plain_name(step.get("state_file")):
            found = from_file(self.checkpoint.path(step["state_file"]), feature, self.checkpoint, self.problems)
        elif step.get("state_file") is not None:
            self.problems.add(where + ": state_file", "a file beside the JSON", repr(step["state_file"]))
        eps = config.get("eps", 1e-8)
        if not isinstance(eps, float) or not 0 <= eps < 1:
            self.problems.add(where + ": eps", "a small number", repr(eps))
        return choose(feature, modes.get(kind, "IDENTITY"), eps, found, self.context)

    def normalizes_pixels(self) -> bool:
        """Whether this converter normalizes pixels by statistics, or the policy has no cameras."""
        features = member(self.checkpoint.config, "input_features", dict, "config.json").values()
        has_cameras = any(isinstance(feature, dict) and feature.get("type") == "VISUAL" for feature in features)
        return "VISUAL" in self.others.values() or not has_cameras

    def finish(self, file: str, required: Sequence[str]) -> None:
        for name in required:
            if name not in self.seen:
                self.problems.add("{}: steps".format(file), "a step " + name, "none")


def relative_columns(width: int, names: Optional[Sequence[str]], exclude: Sequence[str]) -> List[int]:
    """Columns of relative actions: those whose name contains none of the excluded words; all columns without names or words
    (relative_action_processor.py, _build_mask)."""
    known = [name.lower() for name in (names or [])[:width]] if exclude else []
    return [i for i in range(width) if i >= len(known) or not any(word in known[i] for word in exclude)]


def statistics_width(checkpoint: Checkpoint, feature: str, kind: str) -> int:
    """Width of the statistics that the feature's mode reads; 0 if their widths differ or there are none. Reports no problems: reading the
    statistics later does."""
    problems, modes = Problems(""), checkpoint.config.get("normalization_mapping")
    try:
        if checkpoint.processors is None:
            found = from_weights(checkpoint, feature, problems)
        else:
            name = "normalizer_processor" if feature == STATE else "unnormalizer_processor"
            steps = checkpoint.processors[0 if feature == STATE else 1]["steps"]
            step = next(step for step in steps if step.get("registry_name") == name)
            modes, found = step["config"]["norm_map"], from_file(checkpoint.path(step["state_file"]), feature, checkpoint, problems)
        shapes = {found.values[name].shape for name in MODES[modes[kind]][1]}
    except (ConvertError, KeyError, TypeError, AttributeError, StopIteration):
        return 0
    return next(iter(shapes))[0] if len(shapes) == 1 and all(len(shape) == 1 for shape in shapes) else 0


def read_processors(
    checkpoint: Checkpoint,
    dims: Dict[str, int],
    identity: Sequence[str],
    problems: Problems,
    own: Steps,
    min_widths: Optional[Dict[str, int]] = None,
    others: Optional[Mapping[str, str]] = None,
    reads_text: bool = True,
) -> Processors:
    """Reads both pipelines. For the older layout: the equivalent pipelines of the current layout, with the statistics from the weights.

    dims        widths by feature
    own         steps of this architecture, beside those of all policies
    min_widths  for a policy that pads before it normalizes, whose `dims` are the padded widths: the robot's widths. Such a policy also
                builds its prompt itself
    others      features of the observation beside the state that the policy normalizes, with their kind
    reads_text  False: the checkpoint needs no tokenizer
    """
    reader = _Reader(checkpoint, dims, identity, problems, own, min_widths or {}, others or {})
    for feature in identity:
        if feature not in dims:
            problems.add("--identity-stats", " or ".join(dims), feature, code=Code.USAGE)
    if checkpoint.processors is None:
        return _from_weights(checkpoint, reader)
    required = {PRE: ["normalizer_processor"], POST: ["unnormalizer_processor"]}
    if min_widths is None and reads_text:
        required[PRE].insert(0, "tokenizer_processor")
    for file, content in zip((PRE, POST), checkpoint.processors):
        reader.pipeline(file, content)
        reader.finish(file, required[file])
    if checkpoint.old_statistics:
        checkpoint.notes.append("dropped: statistics inside the weights, which the processor files supersede")
    return reader.result


def _from_weights(checkpoint: Checkpoint, reader: _Reader) -> Processors:
    """The pipelines for a checkpoint without processor files. Reference: lerobot processor/migrate_policy_normalization.py."""
    checkpoint.notes.append("no processor files: older layout, statistics from the weights, pipelines as LeRobot's migration makes them")
    config = checkpoint.config
    modes = member(config, "normalization_mapping", dict, "config.json")
    if modes.get("VISUAL", "IDENTITY") != "IDENTITY" and not reader.normalizes_pixels():
        reader.problems.unsupported("config.json: normalization_mapping.VISUAL", "IDENTITY", str(modes["VISUAL"]))
    result = Processors(
        newline=True, max_tokens=reader.token_count("config.json: tokenizer_max_length", config.get("tokenizer_max_length", 48))
    )
    for feature, kind, attribute in ((STATE, "STATE", "state"), (ACTION, "ACTION", "action")):
        found = from_weights(checkpoint, feature, reader.problems)
        setattr(result, attribute, choose(feature, modes.get(kind, "MEAN_STD"), 1e-8, found, reader.context))
    for feature, kind in reader.others.items():
        found = from_weights(checkpoint, feature, reader.problems)
        result.others[feature] = choose(feature, modes.get(kind, "IDENTITY"), 1e-8, found, reader.context)
    return result


def recipe_key(document: Dict[str, List[dict]]) -> Key:
    """The recipe as a key. `document`: ops of image, text, state and action."""
    return Key("processor.recipe", "string", json.dumps(document, ensure_ascii=False))


def letterbox(width: int, height: int, align: str, antialias: bool = False) -> dict:
    """A letterbox op, padded with black: for every policy, the reference pads with 0 before it scales values."""
    size = {"width": width, "height": height}
    return {"op": "letterbox", **size, "filter": "bilinear", "antialias": antialias, "align": align, "fill": 0.0}


def text_ops(processors: Processors, truncate: str) -> List[dict]:
    newline = [{"op": "ensure_suffix", "suffix": "\n"}] if processors.newline else []
    return newline + [{"op": "tokenize", "max_tokens": processors.max_tokens, "truncate": truncate}]


def view_aliases(views: Sequence[str], processors: Processors, notes: List[str], problems: Problems) -> List[str]:
    """For each view the other name that the rename step accepts, or "". Refuses a renaming that a bundle cannot express."""
    aliases = dict.fromkeys(views, "")
    for old, new in processors.rename.items():
        where = "{}: rename_map".format(PRE)
        if new == STATE:
            problems.unsupported(
                where, "renamings of views", "{} -> {}".format(old, new), "remove the entry and send the state as " + STATE
            )
        elif new not in aliases:
            notes.append("{}: {} -> {} renames nothing that the policy reads".format(where, old, new))
        elif old in aliases or aliases[new]:
            problems.unsupported(where, "one other name per view, which is no view itself", "{} -> {}".format(old, new))
        else:
            aliases[new] = old
    return [aliases[view] for view in views]

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Converts LeRobot's GR00T checkpoints (`type: groot`) to the authors' layout: N1.7 here, N1.5 in lerobot_n1_5.py.

LeRobot's class has the network as one attribute, with the sizes of the base, the policy that was fine-tuned. The steps of the pipelines state
cameras, states, actions and statistics: GR00T's own, key by key, if the base has them for the robot; else those of the data set, with one
vector each for states and actions.
Reference: lerobot policies/groot/modeling_groot.py, processor_groot.py and configuration_groot.py of 0.6.1.
"""

from __future__ import annotations

import os
import re
from typing import Any, Dict, List

import numpy as np

from ...checkpoint import Checkpoint
from ...errors import Problems
from ...files import member, read_json
from ...hub import HUB_NAME
from ...recipe import STATE
from ...section import Fixed, Section
from .. import Options
from . import lerobot_files as files
from . import lerobot_n1_5
from .lerobot_files import BATCH, CONFIG, DEVICE, IMAGES, RENAME, Step, Vectors
from .robot import EMBODIMENTS, END, PROCESSOR, STATISTICS

ARCH = "gr00t_n1_7"
PACK, ENCODE, DECODE, UNPACK = (
    "groot_n1_7_pack_inputs_v1",
    "groot_n1_7_vlm_encode_v1",
    "groot_n1_7_action_decode_v1",
    "groot_action_unpack_unnormalize_v2",
)
BEFORE, AFTER = [RENAME, BATCH, PACK, ENCODE, DEVICE], [[DECODE, DEVICE], [UNPACK, DEVICE]]
PACK_FIXED: Fixed = {"state_horizon": (1, 1), "language_key": ("task", "task"), "normalize_min_max": (True, True)}
PACK_READ = """formalize_language embodiment_tag embodiment_mapping clip_outliers use_percentiles video_modality_keys raw_stats modality_config
    max_state_dim max_action_dim""".split()
OF_GR00T = ("raw_stats", "modality_config", "video_modality_keys")  # absent if the statistics are a data set's
# Keys of masks and noise in training.
PACK_IGNORED = {"action_horizon", "valid_action_horizon", "state_dropout_prob"}
ENCODE_READ = ("image_crop_size", "image_target_size", "shortest_image_edge", "crop_fraction", "use_albumentations", "letter_box_transform")
DECODE_READ = ("env_action_dim", "raw_stats", "modality_config", "use_percentiles", "use_relative_action", "action_decode_transform")
UNPACK_FIXED: Fixed = {"normalize_min_max": (True, True)}
# config.json determines the gripper's transform, not the steps (_apply_groot_action_decode_transform).
UNPACK_READ = {"env_action_dim", "clip_normalized_action", "libero_gripper_action", "libero_gripper_binarize"}
OLD_DEFAULTS = {"chunk_size": 50, "n_action_steps": 50}  # defaults of N1.5, which GrootConfig replaces by NEW_DEFAULT
NEW_DEFAULT = 40
TRANSFORMS = {"none": "", "": "", "libero": "libero"}


def as_published(checkpoint: Checkpoint, options: Options) -> Options:
    """Changes LeRobot's checkpoint to the authors' layout. Returns the options with the only robot."""
    if lerobot_n1_5.is_n1_5(checkpoint):
        return lerobot_n1_5.as_published(checkpoint, options)
    problems = Problems(checkpoint.name)
    steps = files.read_steps(checkpoint, BEFORE, AFTER, problems)
    pack, encode = (files.section(steps[name], problems) for name in (PACK, ENCODE))
    _check(checkpoint.config, pack, encode)
    settings = {name: encode.get(name) for name in ENCODE_READ}
    settings |= {name: pack.get(name) for name in ("formalize_language", "clip_outliers", "use_percentiles", "max_state_dim")}
    read = _keys if DECODE in steps else _vectors
    robot, statistics = read(checkpoint, steps, pack, settings, options, problems)
    problems.raise_any()
    tag = pack.get("embodiment_tag")
    settings["modality_configs"] = {tag: robot}
    checkpoint.documents.update(
        {
            PROCESSOR: {"processor_class": "Gr00tN1d7Processor", "processor_kwargs": settings},
            STATISTICS: {tag: statistics},
            EMBODIMENTS: {tag: files.robot_index(pack)},
        }
    )
    own = {name: checkpoint.config[name] for name in ("num_inference_timesteps", "rtc_ramp_rate") if checkpoint.config.get(name) is not None}
    files.take_over(checkpoint, ARCH, {**files.base_config(checkpoint), **own})
    return files.check_robot(options, tag)


def _check(config: dict, pack: Section, encode: Section) -> None:
    policy = Section(CONFIG, config, {}, pack.problems)
    policy.refuse_unknown({*files.CONFIG_FIXED, *files.CONFIG_IGNORED})
    policy.check_fixed(files.CONFIG_FIXED)
    pack.refuse_unknown({*PACK_FIXED, *PACK_READ, *PACK_IGNORED, "video_horizon"})
    pack.check_fixed(PACK_FIXED)
    encode.refuse_unknown({*ENCODE_READ, "model_name", "device"})


def _keys(checkpoint: Checkpoint, steps: Dict[str, Step], pack: Section, settings: Dict[str, Any], options: Options, problems: Problems) -> tuple:
    """The robot's modalities and statistics, from GR00T's own in the steps."""
    decode = files.section(steps[DECODE], problems)
    decode.refuse_unknown(DECODE_READ)
    for name in PACK_READ:
        if pack.get(name) is None:
            pack.bad(name, "a value", hint="the policy was saved without GR00T's own statistics", unsupported=True)
    for name in ("modality_config", "use_percentiles", "raw_stats"):  # without these LeRobot does not decode actions
        if decode.get(name) != pack.get(name):
            decode.bad(name, "the same as of " + PACK, "another")
    robot = dict(member(pack.values, "modality_config", dict, pack.where))
    video = robot.get("video")
    if isinstance(video, dict) and video.get("modality_keys") != pack.get("video_modality_keys"):
        pack.bad("video_modality_keys", "those of modality_config")
    moments = video.get("delta_indices") if isinstance(video, dict) else None
    if isinstance(moments, list) and pack.get("video_horizon") not in (None, len(moments)):
        pack.bad("video_horizon", "{}, the moments of modality_config".format(len(moments)), hint="LeRobot repeats frames", unsupported=True)
    action = member(robot, "action", dict, pack.where)
    delta = action.get("delta_indices")
    if isinstance(delta, list):
        robot["action"] = {**action, "delta_indices": delta[: min([len(delta), *_limits(checkpoint.config)])]}
    settings["use_relative_action"] = decode.get("use_relative_action")
    _check_state(checkpoint, steps[PACK], robot, pack, problems)
    widths = _widths(action, pack)
    if 0 < decode.count("env_action_dim", minimum=0) < sum(widths.values()):
        decode.bad("env_action_dim", "0, or at least the {} numbers of the keys".format(sum(widths.values())), unsupported=True)
    if _transform(checkpoint.config, options, problems):
        if widths.get("gripper") != 1:
            problems.unsupported(CONFIG + ": action_decode_transform", "none, or an action key gripper of one number", "libero")
        _add_gripper(checkpoint, sum(list(widths.values())[: [*widths, "gripper"].index("gripper")]))
    return robot, pack.get("raw_stats")


def _check_state(checkpoint: Checkpoint, step: Step, robot: dict, pack: Section, problems: Problems) -> None:
    """Checks that the statistics in the step's file, which LeRobot uses for states, equal those of the keys, which the bundle uses."""
    stated = member(member(pack.values, "raw_stats", dict, pack.where), "state", dict, pack.where)
    found = files.statistics(checkpoint, step, STATE, problems)
    for name, numbers in zip(("q01", "q99") if pack.get("use_percentiles") else ("min", "max"), found):
        keys = [stated.get(key) for key in member(member(robot, "state", dict, pack.where), "modality_keys", list, pack.where)]
        lists = [values.get(name) if isinstance(values, dict) else None for values in keys]
        wanted = [x for values in lists if isinstance(values, list) for x in values if type(x) in (int, float)]
        if not np.array_equal(np.asarray(wanted, np.float64).astype(np.float32), numbers):
            pack.bad("raw_stats", "the numbers of the step's file", "another {} of the state".format(name))


def _widths(action: dict, pack: Section) -> Dict[str, int]:
    """Width of each key of an action. Problems of the statistics are reported where they are read."""
    statistics = member(member(pack.values, "raw_stats", dict, pack.where), "action", dict, pack.where)
    stated = {str(key): statistics.get(key) for key in member(action, "modality_keys", list, pack.where)}
    lists = {key: values.get("min") if isinstance(values, dict) else None for key, values in stated.items()}
    return {key: len(values) if isinstance(values, list) else 0 for key, values in lists.items()}


def _vectors(checkpoint: Checkpoint, steps: Dict[str, Step], pack: Section, settings: Dict[str, Any], options: Options, problems: Problems) -> tuple:
    """Modalities and statistics of a robot with one vector each for states and actions, from a data set's statistics instead of GR00T's."""
    config, unpack = checkpoint.config, files.section(steps[UNPACK], problems)
    files.refuse_options(options, {"gripper_sign": "the gripper is one of the numbers of an action; action_decode_transform of config.json states its sign"})
    unpack.refuse_unknown({*UNPACK_FIXED, *UNPACK_READ})
    unpack.check_fixed(UNPACK_FIXED)
    clips = [section.get(name) for section, name in ((pack, "clip_outliers"), (unpack, "clip_normalized_action"))]
    if not all(isinstance(value, bool) for value in clips):
        unpack.bad("clip_normalized_action", "true or false, as clip_outliers", str(clips))
    if config.get("use_relative_actions"):
        problems.unsupported(CONFIG + ": use_relative_actions", "False, since no step makes actions relative", "True")
    if pack.get("video_horizon") not in (None, 1):
        pack.bad("video_horizon", "None or 1", hint="LeRobot repeats the frame of now", unsupported=True)
    state = files.state_group(checkpoint, config, steps[PACK], clips[0] is True, problems)
    width = files.action_width(config, unpack)
    action = files.action_group(checkpoint, steps[UNPACK], width, clips[1] is True, problems)
    views = _views(config, pack, checkpoint.notes, problems)
    limits = [*_limits(config), *_limit_of_base(checkpoint, pack)]
    checkpoint.vectors = Vectors(config, views, state, action, files.robot_index(pack), min([1 << 16, *limits]))
    if _transform(config, options, problems) and width >= 7:
        _add_gripper(checkpoint, width - 1)
    settings["use_relative_action"] = False
    return {"video": {"modality_keys": views, "delta_indices": [0]}, "state": {"delta_indices": [0]}}, {}


def _views(config: dict, pack: Section, notes: List[str], problems: Problems) -> List[str]:
    views, keys = files.cameras(config, notes, problems), pack.get("video_modality_keys")
    if keys is None:
        return views
    named = [IMAGES + str(key) for key in keys] if isinstance(keys, list) else []
    if not named or not set(named) <= set(views):
        pack.bad("video_modality_keys", "None, or some of the cameras " + ", ".join(views), unsupported=True)
        return views
    return named


def _transform(config: dict, options: Options, problems: Problems) -> str:
    """The final transform of the gripper: for LIBERO's simulator the sign op, unless the config states another."""
    stated = config.get("action_decode_transform", "auto")
    if stated == "auto":
        stated = "libero" if config.get("embodiment_tag") == "libero_sim" else None
    found = TRANSFORMS.get(str(stated or "").lower())
    if found is None:
        problems.unsupported(CONFIG + ": action_decode_transform", "auto, none or libero", repr(stated))
    if found:
        files.refuse_options(options, {"gripper_sign": "action_decode_transform of config.json turns the gripper already"})
    return found or ""


def _add_gripper(checkpoint: Checkpoint, column: int) -> None:
    """Adds the ops that compute -sign(2 g - 1) of a gripper g."""
    ops = [{"op": "affine", "columns": [column], "scale": -2.0, "shift": 1.0}, {"op": "sign", "columns": [column]}]
    checkpoint.documents[END] = {"ops": ops}


def _limits(config: dict) -> List[int]:
    """Limits of a chunk's rows: LeRobot returns at most chunk_size and n_action_steps rows, and replaces N1.5's defaults of both."""
    found = {name: config.get(name, NEW_DEFAULT) for name in OLD_DEFAULTS}
    return [NEW_DEFAULT if n == OLD_DEFAULTS[name] else n for name, n in found.items() if type(n) is int and n > 0]


def _limit_of_base(checkpoint: Checkpoint, pack: Section) -> List[int]:
    """A further limit of a chunk's rows: the base's action steps for the robot. LeRobot applies it only if the base is a folder, not a name
    on the hub."""
    path = os.path.join(checkpoint.base, PROCESSOR) if checkpoint.base else ""
    named = str(checkpoint.config.get("base_model_path") or "nvidia/")
    if re.fullmatch(HUB_NAME, named) or not os.path.isfile(path):
        return []
    configs = member(member(read_json(path), "processor_kwargs", dict, PROCESSOR), "modality_configs", dict, PROCESSOR)
    robot = configs.get(checkpoint.config.get("embodiment_tag"))
    steps = robot.get("action", {}).get("delta_indices") if isinstance(robot, dict) and isinstance(robot.get("action"), dict) else None
    return [len(steps)] if isinstance(steps, list) and steps else []

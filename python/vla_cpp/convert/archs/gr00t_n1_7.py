# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""GR00T N1.7: Qwen3-VL as the prefix, a diffusion transformer that reads its text and its pictures in turns.

A checkpoint holds several robots, a bundle one of them, chosen by --embodiment. The layout is the authors' (Isaac-GR00T).
"""

from __future__ import annotations

import json
import os
from typing import Dict, List, Sequence

import numpy as np

from .. import recipe
from ..bundle import Key, keys_by_type
from ..checkpoint import Checkpoint, find_backbone
from ..errors import Problems
from ..features import feature_keys
from ..files import member, read_json
from ..section import Section
from ..tokenizer import read_tokenizer
from . import Options, Plan
from ._gr00t_backbone import Fixed, Sizes, check_fixed, refuse_unknown
from ._gr00t_images import read_pictures
from ._gr00t_names import LM, dropped, weights
from ._gr00t_prompt import read_prompt, text_ops
from ._gr00t_robot import (
    PROCESSOR,
    STATISTICS,
    Group,
    Robot,
    choose,
    embodiment_index,
    processor_file,
    read_robot,
    statistics_of,
)
from ._gr00t_sizes import read_sizes

# Gr00tN1d7Processor of Isaac-GR00T. LeRobot reads an absent size of pictures otherwise, so that these must be stated, if only as null.
KWARGS = {
    "modality_configs": None,
    "use_percentiles": False,
    "clip_outliers": True,
    "formalize_language": True,
    "max_state_dim": 29,
    "apply_sincos_state_encoding": False,
    "use_relative_action": False,
    "letter_box_transform": False,
}
STATED = ("image_crop_size", "image_target_size", "shortest_image_edge", "crop_fraction")
FLAGS = [key for key, value in KWARGS.items() if isinstance(value, bool)]
KWARGS_FIXED: Fixed = {
    "use_albumentations": (False, True),
    "model_type": ("qwen", "qwen"),
    "exclude_state": (False, False),
    "use_mean_std": (False, False),
    "use_tactile": (False, False),
    "statistics": (None, None),
    "embodiment_id_mapping": (None, None),
}
KWARGS_IGNORED = set(
    """random_rotation_angle color_jitter_params model_name max_action_dim max_action_horizon extra_augmentation_config
    state_dropout_prob transformers_loading_kwargs tactile_state_keys tactile_input_shape tactile_embed_dim""".split()
)


def plan(checkpoint: Checkpoint, options: Options, problems: Problems) -> Plan:
    processor = _processor(checkpoint, problems)
    robot_config = choose(member(processor.values, "modality_configs", dict, PROCESSOR), options.embodiment)
    folder = find_backbone(checkpoint, options.backbone, checkpoint.config.get("model_name"), "model_name")
    s = read_sizes(checkpoint.config, read_json(os.path.join(folder, "config.json")), problems)
    s.embodiment = embodiment_index(checkpoint, options.embodiment, s.n_embodiment, problems)
    statistics = read_json(processor_file(checkpoint, STATISTICS))
    robot = read_robot(options.embodiment, robot_config, statistics, processor, s.horizon, problems)
    problems.raise_any()
    s.n_slot = len(robot.cameras)
    pictures = read_pictures(processor, folder, options.camera_size, s, checkpoint.notes, problems)
    s.image_width, s.image_height = pictures.width, pictures.height
    tokenizer = read_tokenizer(folder, s.n_vocab, problems, checkpoint.notes)
    problems.raise_any()  # a prompt takes a sound tokenizer
    prompt = read_prompt(tokenizer, folder, s, problems)
    document = {
        "image": pictures.ops,
        "text": text_ops(processor.get("formalize_language"), prompt, s),
        "state": _state(robot, processor, s, problems),
        "action": _action(robot, s, problems),
    }
    keys = [
        *_network_keys(s),
        Key("policy.view_starts", "u32[]", prompt.view_starts),
        *_features(robot, options, checkpoint.notes, problems),
        Key("observation.max_text_tokens", "u32", prompt.n_token),
        *tokenizer.keys,
        Key("processor.recipe", "string", json.dumps(document, ensure_ascii=False)),
    ]
    problems.raise_any()
    hints = {
        LM + "layers.": "select_layer keeps {} language layers, 0 to {}".format(s.n_layer, s.n_layer - 1),
        "action_head.vl_self_attention.": "vl_self_attention_cfg of config.json has {} layers".format(s.n_vl_layer),
    }
    tensors = {**statistics_of(recipe.STATE, robot.states), **statistics_of(recipe.ACTION, robot.actions)}
    return Plan(keys, weights(s), dropped(s), tensors, hints)


def _processor(checkpoint: Checkpoint, problems: Problems) -> Section:
    config = read_json(processor_file(checkpoint, PROCESSOR))
    if config.get("processor_class") != "Gr00tN1d7Processor":
        problems.unsupported(
            PROCESSOR + ": processor_class", "'Gr00tN1d7Processor'", repr(config.get("processor_class"))
        )
    section = Section(PROCESSOR, member(config, "processor_kwargs", dict, PROCESSOR), KWARGS, problems)
    refuse_unknown(section, {*KWARGS, *STATED, *KWARGS_FIXED, *KWARGS_IGNORED})
    check_fixed(section, KWARGS_FIXED)
    for key in STATED:
        if key not in section.values:
            section.bad(
                key, "a value, or null", "no such key", "the reference and LeRobot take different defaults for it"
            )
    for key in FLAGS:
        if not isinstance(section.get(key), bool):
            section.bad(key, "true or false")
    return section


def _total(groups: Sequence[Group]) -> int:
    return sum(group.width for group in groups)


def _op(name: str, feature: str, groups: Sequence[Group]) -> dict:
    kind = "groot_mean_std" if groups[0].mean_std else "groot_min_max"
    return {"op": name, "kind": kind, "stats": "stats." + feature, "eps": 0.0}


def _state(robot: Robot, processor: Section, s: Sizes, problems: Problems) -> List[dict]:
    if processor.count("max_state_dim") != s.d_state:
        processor.bad("max_state_dim", "{} as in config.json".format(s.d_state))
    if _total(robot.states) > s.d_state:
        problems.add(
            STATISTICS + ": state", "at most max_state_dim {} numbers".format(s.d_state), str(_total(robot.states))
        )
    clip = processor.get("clip_outliers") and not robot.states[0].mean_std
    limits = [{"op": "clip", "low": -1.0, "high": 1.0}] if clip else []
    return [_op("normalize", recipe.STATE, robot.states), *limits, {"op": "pad", "size": s.d_state}]


def _action(robot: Robot, s: Sizes, problems: Problems) -> List[dict]:
    width = _total(robot.actions)
    if width > s.d_action:
        problems.add(STATISTICS + ": action", "at most max_action_dim {} numbers".format(s.d_action), str(width))
    limits = [] if robot.actions[0].mean_std else [{"op": "clip", "low": -1.0, "high": 1.0}]
    ops = [{"op": "rows", "count": robot.n_row}, {"op": "take", "size": width}, *limits]
    columns = _relative_columns(robot, problems)
    added = [{"op": "add_state", "columns": columns}] if columns else []
    return [*ops, _op("unnormalize", recipe.ACTION, robot.actions), *added]


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


def _features(robot: Robot, options: Options, notes: List[str], problems: Problems) -> List[Key]:
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


def _network_keys(s: Sizes) -> List[Key]:
    u32 = {
        "policy.d_state": s.d_state,
        "policy.d_action": s.d_action,
        "policy.horizon": s.horizon,
        "policy.n_position": s.n_position,
        "policy.n_slot": s.n_slot,
        "vision.d_model": s.d_vision,
        "vision.n_layer": s.n_vision_layer,
        "vision.n_head": s.n_vision_head,
        "vision.d_ff": s.d_vision_ff,
        "vision.patch_size": s.patch_size,
        "vision.image_width": s.image_width,
        "vision.image_height": s.image_height,
        "vision.n_position_side": s.n_position_side,
        "vision.merge": 2,
        "lm.d_model": s.d_model,
        "lm.n_layer": s.n_layer,
        "lm.n_head": s.n_head,
        "lm.n_head_kv": s.n_head_kv,
        "lm.d_head": s.d_head,
        "lm.d_ff": s.d_ff,
        "lm.n_vocab": s.n_vocab,
        "vl.n_layer": s.n_vl_layer,
        "vl.n_head": s.n_vl_head,
        "vl.d_ff": s.d_vl_ff,
        "dit.d_model": s.d_dit,
        "dit.n_layer": s.n_dit_layer,
        "dit.n_head": s.n_dit_head,
        "dit.d_ff": s.d_dit_ff,
        "dit.d_out": s.d_out,
        "dit.text_every": s.text_every,
        "dit.d_time": s.d_time,
        "dit.n_bucket": s.n_bucket,
        "dit.d_hidden": s.d_hidden,
        "solver.steps": s.n_step,
    }
    # Literals of the reference, but for the language model's.
    f32 = {
        "vision.norm_eps": 1e-6,
        "vision.rope_base": 1e4,
        "lm.norm_eps": s.lm_eps,
        "lm.rope_base": s.rope_base,
        "vl.norm_eps": 1e-5,
        "dit.norm_eps": 1e-5,
        "dit.out_eps": 1e-6,
    }
    f64 = {"solver.t_start": 0.0, "solver.t_end": 1.0}
    text = {"solver.kind": "euler", "solver.noise": "normal"}
    lists = {"vision.deepstack_layers": s.deepstack_layers, "lm.rope_sections": s.rope_sections}
    return keys_by_type({"u32": u32, "f32": f32, "f64": f64, "string": text, "u32[]": lists})

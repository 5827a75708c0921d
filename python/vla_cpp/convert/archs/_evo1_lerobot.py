# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Evo-1 as LeRobot saves it: config.json and the two processor pipelines.

Reference: lerobot src/lerobot/policies/evo1 (configuration, processor, modeling, internvl3_embedder). An absent key means the
default of Evo1Config, which is stated here beside the key.
"""

from __future__ import annotations

import os
from typing import Dict, List

import numpy as np

from .. import recipe
from ..bundle import Key
from ..checkpoint import Checkpoint, find_backbone
from ..errors import Code, Problems
from ..features import feature_keys
from ..files import member, read_json
from ..normalization import Normalization
from ..section import Section
from . import Options
from ._evo1_names import LEROBOT
from ._evo1_sizes import Sizes, check_fixed, check_head, read_hf_backbone
from ._evo1_source import Source, image_ops, pad_op
from ._lerobot import check_keys, read_views, vector_dim

POLICY = {
    "chunk_size": 50,
    "n_action_steps": 50,
    "max_state_dim": 24,
    "max_action_dim": 24,
    "max_views": 3,
    "image_resolution": [448, 448],
    "empty_cameras": 0,
    "postprocess_action_dim": None,
    "vlm_model_name": "OpenGVLab/InternVL3-1B-hf",
    "vlm_num_layers": 14,
    "vlm_dtype": "bfloat16",
    "max_text_length": 1024,
    "embed_dim": 896,
    "hidden_dim": 1024,
    "state_hidden_dim": 1024,
    "num_heads": 8,
    "num_layers": 8,
    "num_inference_timesteps": 32,
}
GRIPPER = {
    "binarize_gripper": False,
    "gripper_index": 6,
    "gripper_threshold": 0.5,
    "gripper_below_threshold_value": 1.0,
    "gripper_above_threshold_value": -1.0,
}
FIXED = {
    "action_head": ("flowmatching", "flowmatching"),
    "num_categories": (1, 1),
    "return_cls_only": (False, False),
}
# Keys that no number of an action chunk depends on.
IGNORED = set(
    """
    training_stage use_flash_attn dropout enable_gradient_checkpointing gradient_checkpointing_use_reentrant finetune_vlm
    finetune_language_model finetune_vision_model finetune_action_head apply_training_stage_defaults task_field embodiment_id_field
    default_embodiment_id
    """.split()
)
PAD_STATE, ACTION_STEP = "evo1_pad_state_processor", "evo1_action_processor"
STEPS: recipe.Steps = {
    recipe.PRE: {
        PAD_STATE: {"max_state_dim": recipe.ANY},
        "evo1_pad_action_processor": {"max_action_dim": recipe.ANY},  # of training
    },
    recipe.POST: {ACTION_STEP: {key: recipe.ANY for key in ("action_dim", *GRIPPER)}},
}
# What the reference fills statistics with up to the padded width (_STAT_PAD_VALUES).
NEUTRAL = {"mean": 0.0, "std": 1.0, "min": -1.0, "max": 1.0, "q01": -1.0, "q99": 1.0, "q10": -1.0, "q90": 1.0}


def read_lerobot(checkpoint: Checkpoint, options: Options, problems: Problems) -> Source:
    if options.position_precision:
        problems.add("--position-precision", "a SmolVLA checkpoint", "type evo1", "leave the option out", Code.USAGE)
    policy = Section("config.json", checkpoint.config, {**POLICY, **GRIPPER}, problems)
    check_keys(policy, "Evo1Config", set(POLICY) | set(GRIPPER) | set(FIXED) | IGNORED, {})
    check_fixed(policy, FIXED)
    sizes = _sizes(policy)
    views, n_empty = read_views(policy, checkpoint)
    if len(views) > sizes.n_slot:
        policy.bad("max_views", "at least the {} cameras".format(len(views)), hint="the reference refuses it too")
    folder = find_backbone(checkpoint, options.backbone, policy.get("vlm_model_name"))
    backbone = read_json(os.path.join(folder, "config.json"))
    read_hf_backbone(backbone, sizes, problems)
    sizes.n_layer = min(sizes.n_layer, sizes.n_backbone_layer)
    if policy.get("image_resolution") != [sizes.image_size] * 2:
        policy.bad("image_resolution", "the tower's {0} x {0}".format(sizes.image_size), hint="the reference refuses it too")
    check_head(policy, sizes, policy.count("embed_dim"))
    problems.raise_any()
    processors = _read_pipelines(policy, checkpoint, options, sizes)
    pad = _pad_value(processors.state, sizes, problems)
    for norm, width in ((processors.state, sizes.state_dim), (processors.action, sizes.action_dim)):
        norm.statistics = {name: value[:width] for name, value in norm.statistics.items()}
    dims = {recipe.STATE: sizes.state_dim, recipe.ACTION: sizes.action_dim}
    arithmetic = policy.get("vlm_dtype")
    if arithmetic not in ("bfloat16", "float32"):
        policy.bad("vlm_dtype", "bfloat16 or float32", unsupported=True)
    return Source(
        sizes=sizes,
        names=LEROBOT,
        tokenizer=folder,
        image_token=backbone.get("image_token_id", 151667),
        image=image_ops(sizes.image_size, "torch_bicubic_8bit", str(arithmetic)),
        state=[*processors.state.op("normalize", recipe.STATE), pad_op(sizes.d_state, pad)],
        action=[
            {"op": "take", "size": sizes.action_dim},
            *processors.action.op("unnormalize", recipe.ACTION),
            *_gripper(policy, sizes.action_dim),
        ],
        features=[
            *_view_keys(views, n_empty, processors, checkpoint, problems),
            Key("observation.states", "string[]", [recipe.STATE]),
            Key("observation.state_dims", "u32[]", [sizes.state_dim]),
            *feature_keys(options.dataset_info, dims, checkpoint.notes, problems),
        ],
        statistics=processors.statistics(),
    )


def _sizes(policy: Section) -> Sizes:
    """A state or an action that the config does not list has the padded width (Evo1Config.validate_features)."""
    s = Sizes(
        n_layer=policy.count("vlm_num_layers", most=1024) if policy.get("vlm_num_layers") is not None else 1024,
        n_token=policy.count("max_text_length"),
        n_head_layer=policy.count("num_layers", most=1024),
        n_head_head=policy.count("num_heads"),
        d_hidden=policy.count("hidden_dim"),
        d_state_hidden=policy.count("state_hidden_dim"),
        d_state=policy.count("max_state_dim"),
        d_action=policy.count("max_action_dim"),
        horizon=policy.count("chunk_size"),
        n_slot=policy.count("max_views", most=32),
        n_step=policy.count("num_inference_timesteps"),
        time_scale=999.0,
        dead_rows="unseen",
        absent_views="last",
    )
    s.state_dim, s.d_robot = s.d_state, s.d_action
    if recipe.STATE in member(policy.values, "input_features", dict, "config.json"):
        s.state_dim = vector_dim(policy, "input_features", recipe.STATE, "STATE")
    if recipe.ACTION in member(policy.values, "output_features", dict, "config.json"):
        s.d_robot = vector_dim(policy, "output_features", recipe.ACTION, "ACTION")
    for key, padded, real in (("max_state_dim", s.d_state, s.state_dim), ("max_action_dim", s.d_action, s.d_robot)):
        if real > padded:
            policy.bad(key, "at least the feature's width {}".format(real))
    if policy.count("n_action_steps") > s.horizon:
        policy.bad("n_action_steps", "at most chunk_size {}".format(s.horizon), hint="the reference refuses it too")
    s.action_dim = s.d_robot
    if policy.get("postprocess_action_dim") is not None:
        hint = "the network does not compute the other columns"
        if policy.count("postprocess_action_dim") > s.d_robot:
            policy.bad("postprocess_action_dim", "at most the action's width {}".format(s.d_robot), hint=hint, unsupported=True)
        s.action_dim = min(policy.count("postprocess_action_dim"), s.d_robot)
    return s


def _read_pipelines(policy: Section, checkpoint: Checkpoint, options: Options, s: Sizes) -> recipe.Processors:
    problems = policy.problems
    if checkpoint.processors is None:
        problems.unsupported(recipe.PRE, "the pipelines of LeRobot, with statistics", "none", "save the policy again")
        problems.raise_any()
    dims = {recipe.STATE: s.d_state, recipe.ACTION: s.d_action}
    least = {recipe.STATE: s.state_dim, recipe.ACTION: s.d_robot}
    processors = recipe.read_processors(checkpoint, dims, options.identity_stats, problems, STEPS, least)
    problems.raise_any()
    pre, post = (
        [(step.get("registry_name", step.get("class")), step.get("config", {})) for step in file["steps"]]
        for file in checkpoint.processors
    )
    order, configs = [name for name, _ in pre], dict(pre + post)
    if "tokenizer_processor" in order:
        problems.unsupported(recipe.PRE, "no tokenizer_processor: the policy builds its own prompt", "one")
    if PAD_STATE not in order or order.index(PAD_STATE) > order.index("normalizer_processor"):
        problems.unsupported(recipe.PRE, PAD_STATE + " before normalization", "another order, or none")
    elif configs[PAD_STATE].get("max_state_dim", 24) != s.d_state:
        problems.add(recipe.PRE + ": max_state_dim", "{} as in config.json".format(s.d_state), str(configs[PAD_STATE]))
    order = [name for name, _ in post]
    if ACTION_STEP in order:
        if order.index(ACTION_STEP) < order.index("unnormalizer_processor"):
            problems.unsupported(recipe.POST, ACTION_STEP + " after un-normalization", "the opposite order")
        # The reference builds this step again from config.json; a file that says otherwise contradicts it.
        stated = {"action_dim": s.action_dim, **{key: policy.get(key) for key in GRIPPER}}
        for key, value in configs[ACTION_STEP].items():
            if value != stated[key]:
                problems.add("{}: {}".format(recipe.POST, key), "{!r} as config.json has it".format(stated[key]), repr(value))
    return processors


def _pad_value(norm: Normalization, s: Sizes, problems: Problems) -> float:
    """What the reference's order makes of padded columns: zeros are appended to the state first, and normalized with the rest, by
    neutral statistics unless the file has others for those columns."""
    padded: Dict[str, np.ndarray] = {}
    for name, value in norm.statistics.items():
        fill = np.full(s.d_state - value.size, NEUTRAL[name], np.float32)
        padded[name] = np.concatenate([value.astype(np.float32), fill])[s.state_dim :]
    numbers = _normalized_zero(norm, padded)
    if numbers.size == 0 or (numbers == 0).all():
        return 0.0
    if not np.isfinite(numbers).all() or (numbers != numbers[0]).any():
        problems.unsupported(
            "statistics of " + recipe.STATE,
            "statistics that make one number of all padded columns",
            str(numbers)[:80],
            "the recipe pads with one number",
        )
    return float(numbers[0])


def _normalized_zero(norm: Normalization, stats: Dict[str, np.ndarray]) -> np.ndarray:
    """The formulas of normalize_processor.py at 0, in float32."""
    if not stats:
        return np.zeros(0, np.float32)
    eps = np.float32(norm.eps)
    if norm.kind == "mean_std":
        return (np.float32(0) - stats["mean"]) / (stats["std"] + eps)
    low, high = stats.values()  # in the order in which MODES names them
    span = high - low
    return np.float32(2) * (np.float32(0) - low) / np.where(span == 0, eps, span) - np.float32(1)


def _gripper(policy: Section, width: int) -> List[dict]:
    if policy.get("binarize_gripper") is False:
        return []
    if policy.get("binarize_gripper") is not True:
        policy.bad("binarize_gripper", "true or false")
    column = policy.count("gripper_index", least=0)
    if column >= width:
        policy.bad("gripper_index", "a column of the action, below {}".format(width), hint="the reference refuses it too")
    above, high, low = (
        policy.number("gripper_" + name, above=-1e30)
        for name in ("threshold", "above_threshold_value", "below_threshold_value")
    )
    return [{"op": "threshold", "columns": [column], "above": above, "then": high, "else": low}]


def _view_keys(
    views: List[str], n_empty: int, processors: recipe.Processors, checkpoint: Checkpoint, problems: Problems
) -> List[Key]:
    """The reference takes an unmentioned camera as absent, of any name, but no more of them than `empty_cameras`."""
    return [
        Key("observation.views", "string[]", views),
        Key("observation.view_aliases", "string[]", recipe.view_aliases(views, processors, checkpoint.notes, problems)),
        Key("observation.view_optional", "u32[]", [1] * len(views)),
        Key("observation.min_views", "u32", max(1, len(views) - n_empty)),
    ]

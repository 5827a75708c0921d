# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""π0 and π0.5 as LeRobot saves them: config.json and the two processor pipelines.

Reference: lerobot src/lerobot/policies/{pi0,pi05}/{configuration,processor,modeling}_*.py. An absent key means the default of the
reference's own class, which is stated here beside the key.
"""

from __future__ import annotations

from typing import Dict, List

from .. import recipe
from ..bundle import Key
from ..checkpoint import Checkpoint
from ..errors import Problems
from ..features import feature_keys
from ..section import Section
from . import Options
from ._lerobot import check_keys, read_views, vector_dim, view_keys
from ._pi_sizes import Sizes, check_image, read_towers
from ._pi_source import Family, Source

POLICY: Dict[str, object] = {
    "paligemma_variant": "gemma_2b",
    "action_expert_variant": "gemma_300m",
    "dtype": "float32",
    "chunk_size": 50,
    "n_action_steps": 50,
    "max_state_dim": 32,
    "max_action_dim": 32,
    "num_inference_steps": 10,
    "min_period": 4e-3,
    "max_period": 4.0,
    "image_resolution": [224, 224],
    "empty_cameras": 0,
    "use_relative_actions": False,
    "relative_exclude_joints": ["gripper"],
    "action_feature_names": None,
}
FIXED = {
    "use_visual_memory": (False, "the runtime keeps no memory of frames"),
    "use_proprioceptive_memory": (False, "the runtime keeps no memory of states"),
}
# Keys that no number of an action chunk depends on.
IGNORED = set(
    """
    tokenizer_max_length time_sampling_beta_alpha time_sampling_beta_beta time_sampling_scale time_sampling_offset
    freeze_vision_encoder train_expert_only gradient_checkpointing rtc_training_max_delay
    """.split()
)
STEPS: recipe.Steps = {
    recipe.PRE: {
        "pi0_new_line_processor": {},
        "pi05_prepare_state_tokenizer_processor_step": {"max_state_dim": recipe.ANY, "task_key": ("task",)},
        "relative_actions_processor": {"enabled": (True, False), "exclude_joints": recipe.ANY, "action_names": recipe.ANY},
    },
    recipe.POST: {"absolute_actions_processor": {"enabled": (True, False)}},
}
CLEAN = [{"op": "strip"}, {"op": "replace", "from": "_", "to": " "}, {"op": "replace", "from": "\n", "to": " "}]
PROMPT = {"op": "template", "text": "Task: {instruction}, State: {state};\nAction: "}
WORDS = {"op": "bins", "low": -1.0, "high": 1.0, "count": 256}


def read_lerobot(family: Family, checkpoint: Checkpoint, options: Options, problems: Problems) -> Source:
    policy = Section("config.json", checkpoint.config, POLICY, problems)
    memory = {key for key in policy.values if key.startswith("memory_")}  # of the two kinds that FIXED refuses
    check_keys(policy, family.config_class, set(POLICY) | IGNORED | memory, FIXED)
    sizes = read_towers(policy, checkpoint, problems)
    check_image(policy, "image_resolution", sizes, policy.get("image_resolution"))
    views, _ = read_views(policy, checkpoint)
    _read_policy(family, policy, sizes)
    problems.raise_any()
    if checkpoint.processors is None:
        problems.unsupported(
            recipe.PRE,
            "the pipelines of LeRobot, with statistics",
            "none: a layout of before September 2025",
            "load the policy with a current LeRobot and save it again",
        )
        problems.raise_any()
    dims = {recipe.STATE: sizes.state_dim, recipe.ACTION: sizes.action_dim}
    processors = recipe.read_processors(checkpoint, dims, options.identity_stats, problems, STEPS)
    _check_pipelines(family, policy, processors)
    features = [
        *view_keys(checkpoint, views, processors, problems),
        Key("observation.states", "string[]", [recipe.STATE]),
        Key("observation.state_dims", "u32[]", [sizes.state_dim]),
        *feature_keys(options.dataset_info, dims, checkpoint.notes, problems),
    ]
    return Source(
        sizes=sizes,
        processors=processors,
        image=[
            recipe.letterbox(sizes.image_size, sizes.image_size, "center"),
            {"op": "clip", "low": 0.0, "high": 1.0},
            {"op": "affine", "scale": 2.0, "shift": -1.0},
        ],
        text=_text(processors),
        state=_state(family, sizes, processors),
        action=_action(sizes, processors),
        features=features,
        statistics=processors.statistics(),
        max_tokens=processors.max_tokens,
    )


def _read_policy(family: Family, policy: Section, s: Sizes) -> None:
    """A state or an action that the config does not list has the padded width (PI0Config.validate_features)."""
    d_state, s.d_action = policy.count("max_state_dim"), policy.count("max_action_dim")
    s.state_dim, s.action_dim = d_state, s.d_action
    if recipe.STATE in (policy.get("input_features") or {}):
        s.state_dim = vector_dim(policy, "input_features", recipe.STATE, "STATE")
    if recipe.ACTION in (policy.get("output_features") or {}):
        s.action_dim = vector_dim(policy, "output_features", recipe.ACTION, "ACTION")
    s.d_state = d_state if family.state_token else 0
    for key, padded, real in (("max_state_dim", d_state, s.state_dim), ("max_action_dim", s.d_action, s.action_dim)):
        if real > padded and (family.state_token or key != "max_state_dim"):
            policy.bad(key, "at least the feature's width {}".format(real))
    s.horizon, s.n_step = policy.count("chunk_size"), policy.count("num_inference_steps")
    if policy.count("n_action_steps") > s.horizon:
        policy.bad("n_action_steps", "at most chunk_size {}".format(s.horizon), hint="the reference refuses it too")
    s.min_period, s.max_period = policy.number("min_period"), policy.number("max_period")
    if policy.get("dtype") not in ("float32", "bfloat16"):
        policy.bad("dtype", "float32 or bfloat16", hint="the reference refuses it too", unsupported=True)


def _check_pipelines(family: Family, policy: Section, processors: recipe.Processors) -> None:
    wanted, found = ("pi0_new_line_processor", processors.newline) if family.state_token else (
        "pi05_prepare_state_tokenizer_processor_step",
        processors.state_words,
    )
    if not found or (processors.newline and processors.state_words):
        policy.problems.add(recipe.PRE + ": steps", "{}, and not the other family's".format(wanted), "other steps")
    if processors.relative != bool(policy.get("use_relative_actions")):
        policy.bad("use_relative_actions", "{} as the pipelines have it".format(processors.relative))


def _text(processors: recipe.Processors) -> List[dict]:
    return [*CLEAN, PROMPT] if processors.state_words else [{"op": "ensure_suffix", "suffix": "\n"}]


def _state(family: Family, s: Sizes, processors: recipe.Processors) -> List[dict]:
    last = {"op": "pad", "size": s.d_state} if family.state_token else WORDS
    return [*processors.state.op("normalize", recipe.STATE), last]


def _action(s: Sizes, processors: recipe.Processors) -> List[dict]:
    relative = [{"op": "add_state", "columns": list(processors.add_state)}] if processors.add_state else []
    take = {"op": "take", "size": s.action_dim}
    return [take, *processors.action.op("unnormalize", recipe.ACTION), *relative]

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The two layouts of π0 and π0.5.

LeRobot's layout: config.json and the two processor pipelines.

Reference: lerobot src/lerobot/policies/{pi0,pi05}/{configuration,processor,modeling}_*.py. An absent key has the default of the
reference's own class, listed here with the key.

openpi's layout: weights, from its PyTorch code or from its JAX code (jax_layout.py), and statistics under assets/. openpi's training
configurations define everything else about a robot, so this module has those with a published recipe, by name.

Reference: openpi src/openpi/training/config.py, policies/{aloha,droid,libero}_policy.py, transforms.py, models/tokenizer.py.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Dict, List, NamedTuple, Sequence, Tuple

import numpy as np

from ... import recipe
from ...bundle import Key
from ...checkpoint import Checkpoint
from ...errors import Code, Problems, refuse
from ...features import robot_keys, views_of
from ...files import member, read_json
from ...lerobot import action_width, check_keys, check_widths, no_position_rule, read_views, state_width, view_keys
from ...section import Section
from .. import Options
from .mapping import Family, Sizes, check_image, read_towers


class Source(NamedTuple):
    """The results of reading a layout: sizes, recipe, features, statistics."""

    sizes: Sizes
    processors: recipe.Processors  # empty for openpi, which has no processors
    image: List[dict]
    text: List[dict]  # the text ops except the last one
    state: List[dict]
    action: List[dict]
    features: List[Key]
    statistics: Dict[str, np.ndarray]
    max_tokens: int


# --- LeRobot's layout ------------------------------------------------------------------------------------------------------------------

LEROBOT_CONFIG: Dict[str, object] = {
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
LEROBOT_FIXED = {
    "use_visual_memory": (False, "the runtime keeps no memory of frames"),
    "use_proprioceptive_memory": (False, "the runtime keeps no memory of states"),
}
# Keys without effect on the numbers of an action chunk.
LEROBOT_IGNORED = set(
    """
    tokenizer_max_length time_sampling_beta_alpha time_sampling_beta_beta time_sampling_scale time_sampling_offset
    freeze_vision_encoder train_expert_only gradient_checkpointing rtc_training_max_delay
    """.split()
)
# Keys of LeRobot's first PI0Config, which had no processor files.
OLDER = set("proj_width attention_implementation num_steps resize_imgs_with_padding adapt_to_pi_aloha train_state_proj".split())
STEPS: recipe.Steps = {
    recipe.PRE: {
        "pi0_new_line_processor": {},
        "pi05_prepare_state_tokenizer_processor_step": {"max_state_dim": recipe.ANY, "task_key": ("task",)},
        **recipe.RELATIVE[recipe.PRE],
    },
    recipe.POST: recipe.RELATIVE[recipe.POST],
}
CLEAN = [{"op": "strip"}, {"op": "replace", "from": "_", "to": " "}, {"op": "replace", "from": "\n", "to": " "}]
PROMPT = {"op": "template", "text": "Task: {instruction}, State: {state};\nAction: "}
BINS = {"op": "bins", "low": -1.0, "high": 1.0, "count": 256}


def read_lerobot(family: Family, checkpoint: Checkpoint, options: Options, problems: Problems) -> Source:
    _refuse_older(checkpoint)
    policy = Section("config.json", checkpoint.config, LEROBOT_CONFIG, problems)
    no_position_rule(policy, options, problems)
    memory = {key for key in policy.values if key.startswith("memory_")}  # settings of the two kinds of memory that LEROBOT_FIXED refuses
    check_keys(policy, family.config_class, set(LEROBOT_CONFIG) | LEROBOT_IGNORED | memory, LEROBOT_FIXED)
    sizes = read_towers(policy, checkpoint, problems)
    check_image(policy, "image_resolution", sizes, policy.get("image_resolution"))
    views, _ = read_views(policy, checkpoint)
    _read_policy(family, policy, checkpoint, options, sizes)
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
    keys = view_keys(checkpoint, views, processors, problems)
    return Source(
        sizes=sizes,
        processors=processors,
        image=[
            recipe.letterbox(*[sizes.vision.image_size] * 2, "center"),
            {"op": "clip", "low": 0.0, "high": 1.0},
            {"op": "affine", "scale": 2.0, "shift": -1.0},
        ],
        text=_text(processors),
        state=_state(family, sizes, processors),
        action=_action(sizes, processors),
        features=robot_keys(keys, dims, options.dataset_info, checkpoint.notes, problems),
        statistics=processors.statistics(),
        max_tokens=processors.max_tokens,
    )


def _refuse_older(checkpoint: Checkpoint) -> None:
    """Refuses a policy of LeRobot's first PI0Config, whose network had other arithmetic. Errors: unsupported."""
    found = sorted(OLDER & set(checkpoint.config))
    if found and checkpoint.processors is None:
        hint = "today's LeRobot cannot load it either: LeRobot 0.3.3 serves it, or fine-tune today's base, lerobot/pi0_base"
        expected, where = "a policy that LeRobot saved in September 2025 or later", "config.json"
        raise refuse(where, expected, "an older layout, by its keys {}".format(", ".join(found)), hint, Code.UNSUPPORTED)


def _read_policy(family: Family, policy: Section, checkpoint: Checkpoint, options: Options, s: Sizes) -> None:
    """Reads the policy's sizes. A state or action that the config does not list has the padded width (PI0Config.validate_features)."""
    d_state, s.d_action = policy.count("max_state_dim"), policy.count("max_action_dim")
    s.state_dim, s.action_dim = d_state, s.d_action
    if recipe.STATE in (policy.get("input_features") or {}):
        s.state_dim = state_width(policy, checkpoint, options)
    if recipe.ACTION in (policy.get("output_features") or {}):
        s.action_dim = action_width(policy, checkpoint, options)
    s.d_state = d_state if family.state_token else 0
    widths = {"max_state_dim": (d_state, s.state_dim)} if family.state_token else {}
    check_widths(policy, {**widths, "max_action_dim": (s.d_action, s.action_dim)})
    s.horizon, s.n_step = policy.count("chunk_size"), policy.count("num_inference_steps")
    s.min_period, s.max_period = policy.number("min_period"), policy.number("max_period")
    if policy.get("dtype") not in ("float32", "bfloat16"):
        policy.bad("dtype", "float32 or bfloat16", hint="the reference refuses it too", unsupported=True)


def _check_pipelines(family: Family, policy: Section, processors: recipe.Processors) -> None:
    wanted, found = (
        ("pi0_new_line_processor", processors.newline)
        if family.state_token
        else ("pi05_prepare_state_tokenizer_processor_step", processors.discrete_state)
    )
    if not found or (processors.newline and processors.discrete_state):
        policy.problems.add(recipe.PRE + ": steps", "{}, and not the other family's".format(wanted), "other steps")
    if processors.relative != bool(policy.get("use_relative_actions")):
        policy.bad("use_relative_actions", "{} as the pipelines have it".format(processors.relative))


def _text(processors: recipe.Processors) -> List[dict]:
    return [*CLEAN, PROMPT] if processors.discrete_state else [{"op": "ensure_suffix", "suffix": "\n"}]


def _state(family: Family, s: Sizes, processors: recipe.Processors) -> List[dict]:
    last = {"op": "pad", "size": s.d_state} if family.state_token else BINS
    return [*processors.state.op("normalize", recipe.STATE), last]


def _action(s: Sizes, processors: recipe.Processors) -> List[dict]:
    relative = [{"op": "add_state", "columns": list(processors.add_state)}] if processors.add_state else []
    take = {"op": "take", "size": s.action_dim}
    return [take, *processors.action.op("unnormalize", recipe.ACTION), *relative]


# --- openpi's layout -------------------------------------------------------------------------------------------------------------------

STATS_FILE = "norm_stats.json"
SIDE = 224  # every configuration resizes images to this side (ModelTransformFactory)
EPS = 1e-6
NEWLINE = {"op": "ensure_suffix", "suffix": "\n"}
# Keys of config.json, if openpi's converter from JAX wrote one, with the defaults of models/pi0_config.py.
OPENPI_CONFIG: Dict[str, object] = {
    "action_dim": 32,
    "paligemma_variant": "gemma_2b",
    "action_expert_variant": "gemma_300m",
    "precision": "bfloat16",
}


class Robot(NamedTuple):
    """A robot's inputs and outputs. views: (name, name in openpi's observations, whether an act may leave it out)."""

    views: Sequence[Tuple[str, str, bool]]
    states: Sequence[Tuple[str, int]]
    n_action: int
    decode: Sequence[dict] = ()  # ops that convert the state to the network's conventions, before normalization
    encode: Sequence[dict] = ()  # ops that convert actions to the robot's conventions, at the end


# aloha_policy.py: four joints have the opposite sign; gripper values are metres for the robot and servo angles for the network.
FLIP = {"op": "affine", "columns": [1, 2, 8, 9], "scale": -1.0, "shift": 0.0}
GRIPPERS = [6, 13]
ALOHA_VIEWS = (("cam_high", "", False), ("cam_left_wrist", "", True), ("cam_right_wrist", "", True))
ALOHA = Robot(
    views=ALOHA_VIEWS,
    states=(("state", 14),),
    n_action=14,
    decode=(
        FLIP,
        {"op": "horn_angle", "columns": GRIPPERS, "scale": 0.05800 - 0.01844, "shift": 0.01844, "arm_length": 0.036, "horn_radius": 0.022},
        {"op": "affine", "columns": GRIPPERS, "scale": 1 / (1.6296 - 0.5476), "shift": -0.5476 / (1.6296 - 0.5476)},
    ),
    encode=(FLIP, {"op": "affine", "columns": GRIPPERS, "scale": 1 / (1.4910 + 0.6213), "shift": (0.5476 + 0.6213) / (1.4910 + 0.6213)}),
)
DROID = Robot(
    views=(
        ("exterior_image_1_left", "observation/exterior_image_1_left", False),
        ("wrist_image_left", "observation/wrist_image_left", False),
    ),
    states=(("joint_position", 7), ("gripper_position", 1)),
    n_action=8,
)
LIBERO = Robot(
    views=(("image", "observation/image", False), ("wrist_image", "observation/wrist_image", False)), states=(("state", 8),), n_action=7
)
ROBOTS = {"aloha": ALOHA, "droid": DROID, "libero": LIBERO}
# Columns of relative actions, the joints; grippers are absolute (make_bool_mask).
ALOHA_JOINTS = [*range(6), *range(7, 13)]


@dataclass(frozen=True)
class Variant:
    """The part of a TrainConfig that affects inference."""

    arch: str
    robot: Robot
    asset: str
    horizon: int = 50
    relative: Sequence[int] = ()
    discrete_state: bool = True  # discrete_state_input, only for pi05


LIBERO_ASSET = "physical-intelligence/libero"
VARIANTS = {
    "pi0_aloha": Variant("pi0", ALOHA, "trossen", relative=ALOHA_JOINTS),
    "pi0_aloha_towel": Variant("pi0", ALOHA, "trossen", relative=ALOHA_JOINTS),
    "pi0_aloha_tupperware": Variant("pi0", ALOHA, "trossen", relative=ALOHA_JOINTS),
    "pi0_aloha_pen_uncap": Variant("pi0", ALOHA, "trossen", relative=ALOHA_JOINTS),
    "pi0_aloha_sim": Variant("pi0", ALOHA, "lerobot/aloha_sim_transfer_cube_human"),
    "pi0_droid": Variant("pi0", DROID, "droid", horizon=10),
    "pi0_libero": Variant("pi0", LIBERO, LIBERO_ASSET, relative=range(6)),
    "pi0_libero_low_mem_finetune": Variant("pi0", LIBERO, LIBERO_ASSET, relative=range(6)),  # trained with LoRA
    "pi05_aloha": Variant("pi05", ALOHA, "trossen", relative=ALOHA_JOINTS),
    "pi05_aloha_pen_uncap": Variant("pi05", ALOHA, "trossen", relative=ALOHA_JOINTS),
    "pi05_droid": Variant("pi05", DROID, "droid", horizon=15),
    "pi05_droid_finetune": Variant("pi05", DROID, "droid", horizon=16),
    "pi05_full_droid_finetune": Variant("pi05", DROID, "droid", horizon=16, relative=range(7)),
    "pi05_libero": Variant("pi05", LIBERO, LIBERO_ASSET, horizon=10, discrete_state=False),
}


def variants_of(arch: str) -> List[str]:
    return [name for name, variant in VARIANTS.items() if variant.arch == arch]


def read_variant(checkpoint: Checkpoint, name: str) -> Variant:
    """The configuration of that name, or in the JSON file of that path or of that name in the checkpoint."""
    if name in VARIANTS:
        return VARIANTS[name]
    path = name if os.path.exists(name) else checkpoint.path(name)
    given = Section(name, member({"it": read_json(path)}, "it", dict, name), VARIANT_FILE, Problems(name))
    for key in sorted(set(given.values) - set(VARIANT_FILE)):
        given.bad(key, "one of " + ", ".join(VARIANT_FILE))
    own = given.get("robot") not in [*ROBOTS]
    if not own and set(given.values) & {"views", "states", "actions"}:
        given.bad("robot", "either a robot of openpi, or views, states and actions")
    elif given.get("robot") and own:
        given.bad("robot", " or ".join(ROBOTS))
    robot = _own_robot(given) if own else ROBOTS[given.get("robot")]
    if given.get("model") not in ("pi0", "pi05"):
        given.bad("model", "pi0 or pi05")
    for key in ("discrete_state", "relative", "assets"):
        kind = type(VARIANT_FILE[key])
        if not isinstance(given.get(key), kind):
            given.bad(key, {bool: "true or false", list: "columns of actions", str: "a folder below assets"}[kind])
    horizon = given.count("horizon", maximum=4096)
    given.problems.raise_any()
    relative, most = given.get("relative"), min(robot.n_action, sum(width for _, width in robot.states))
    if any(isinstance(i, bool) or not isinstance(i, int) or not 0 <= i < most for i in relative):
        given.bad("relative", "columns below {}, which state and actions have".format(most))
    if any(part in ("", ".", "..") for part in given.get("assets").split("/")):
        given.bad("assets", "a folder below assets")
    given.problems.raise_any()
    return Variant(given.get("model"), robot, given.get("assets"), horizon, relative, given.get("discrete_state"))


def _own_robot(given: Section) -> Robot:
    views, states = given.get("views"), given.get("states")
    if not _names(views, str) or len(views) > MAX_VIEWS:
        given.bad("views", "1 to {} views, each with its name in the client's observations, in the order of the network's".format(MAX_VIEWS))
    if not _names(states, int):
        given.bad("states", "widths of one state or several, in their order")
    n_action = given.count("actions")
    given.problems.raise_any()
    return Robot([(view, alias, False) for view, alias in views.items()], list(states.items()), n_action)


# Keys of a user's own TrainConfig, for one of openpi's robots, or for a robot whose transforms only name, normalize and make relative.
VARIANT_FILE: Dict[str, object] = {
    "model": "",
    "robot": "",
    "views": {},
    "states": {},
    "actions": None,
    "horizon": None,
    "relative": [],
    "discrete_state": True,
    "assets": "",
}
MAX_VIEWS = 3  # views of openpi's models


def _names(value: object, kind: type) -> bool:
    """Whether `value` is a non-empty dict with values of that type; numbers must be above 0."""
    if not isinstance(value, dict) or not value:
        return False
    return all(key and isinstance(x, kind) and not isinstance(x, bool) and (kind is str or x > 0) for key, x in value.items())


def read_openpi(family: Family, checkpoint: Checkpoint, options: Options, problems: Problems) -> Source:
    variant = read_variant(checkpoint, options.variant)
    robot = variant.robot
    policy = Section("config.json", checkpoint.config, dict(OPENPI_CONFIG, action_horizon=variant.horizon), problems)
    for key in sorted(set(policy.values) - set(policy.defaults)):
        policy.bad(key, "a key that openpi writes", unsupported=True)
    sizes = _openpi_sizes(family, policy, checkpoint, variant, problems)
    statistics = _statistics(family, checkpoint, variant, problems)
    problems.raise_any()
    kind = "openpi_mean_std" if family.state_token else "openpi_quantiles"
    state_names = ["observation." + name for name, _ in robot.states]
    return Source(
        sizes=sizes,
        processors=recipe.Processors(),
        image=[recipe.letterbox(*[sizes.vision.image_size] * 2, "center", antialias=True), {"op": "affine", "scale": 2.0, "shift": -1.0}],
        text=[*CLEAN, PROMPT] if _state_in_prompt(family, variant) else [*CLEAN, NEWLINE],
        state=[*robot.decode, *(_normalize("normalize", kind, name, state_names) for name in state_names)]
        + [_state_end(family, variant, sizes)],
        action=[
            {"op": "take", "size": robot.n_action},
            _normalize("unnormalize", kind, recipe.ACTION, []),
            *([{"op": "add_state", "columns": list(variant.relative)}] if variant.relative else []),
            *robot.encode,
        ],
        features=_openpi_features(robot, state_names, sizes, checkpoint, options, problems),
        statistics=statistics,
        max_tokens=family.max_tokens,
    )


def _state_in_prompt(family: Family, variant: Variant) -> bool:
    return not family.state_token and variant.discrete_state


def _state_end(family: Family, variant: Variant, s: Sizes) -> dict:
    if family.state_token:
        return {"op": "pad", "size": s.d_state}
    return BINS if variant.discrete_state else {"op": "drop"}


def _normalize(op: str, kind: str, feature: str, features: Sequence[str]) -> dict:
    one_of_several = {"feature": feature} if len(features) > 1 else {}
    return {"op": op, "kind": kind, "stats": "stats." + feature, "eps": EPS, **one_of_several}


def _openpi_sizes(family: Family, policy: Section, checkpoint: Checkpoint, variant: Variant, problems: Problems) -> Sizes:
    s = read_towers(policy, checkpoint, problems)
    check_image(policy, "image size", s, [s.vision.image_size or SIDE] * 2)
    s.state_dim, s.action_dim = sum(width for _, width in variant.robot.states), variant.robot.n_action
    s.d_action = policy.count("action_dim")
    s.d_state = s.d_action if family.state_token else 0
    if max(s.state_dim, s.action_dim) > s.d_action:
        policy.bad("action_dim", "at least the robot's {} numbers".format(max(s.state_dim, s.action_dim)))
    s.horizon, s.n_step = policy.count("action_horizon"), 10
    s.min_period, s.max_period = 4e-3, 4.0
    s.solver = "euler_float32"  # sample_actions accumulates time in a float32 tensor
    if policy.get("precision") not in ("bfloat16", "float32", "float16"):
        policy.bad("precision", "bfloat16, float32 or float16", unsupported=True)
    return s


def _statistics(family: Family, checkpoint: Checkpoint, variant: Variant, problems: Problems) -> Dict[str, np.ndarray]:
    """The statistics by the name of the bundle's tensor, without the padding that the files add to the robot's widths. The file has doubles."""
    path = os.path.join(checkpoint.path("assets"), *variant.asset.split("/"), STATS_FILE)
    where = os.path.relpath(path, checkpoint.folder)
    if not os.path.exists(path):
        problems.add(
            where,
            "the statistics of the embodiment that the variant names",
            "none; there are some for " + (", ".join(_assets(checkpoint)) or "no embodiment"),
            "choose the --variant of one of these, or copy the file from the training run's assets",
        )
        return {}
    stats = member(read_json(path), "norm_stats", dict, where)
    names = ("mean", "std") if family.state_token else ("q01", "q99")
    result: Dict[str, np.ndarray] = {}
    for key, parts in (("state", variant.robot.states), ("actions", [("action", variant.robot.n_action)])):
        widths = [width for _, width in parts]
        for name in names:
            values = _values(stats, key, name, sum(widths), where, problems)
            for (feature, _), part in zip(parts, np.split(values, np.cumsum(widths)[:-1])):
                full = recipe.ACTION if feature == "action" else "observation." + feature
                result["stats.{}.{}".format(full, name)] = part
    return result


def _assets(checkpoint: Checkpoint) -> List[str]:
    root = checkpoint.path("assets")
    found = [os.path.relpath(folder, root) for folder, _, files in os.walk(root) if STATS_FILE in files]
    return sorted(name.replace(os.sep, "/") for name in found)


def _values(stats: dict, key: str, name: str, width: int, where: str, problems: Problems) -> np.ndarray:
    known = member(stats, key, dict, where + ": norm_stats")
    values = known.get(name)
    place = "{}: norm_stats.{}.{}".format(where, key, name)
    numbers = isinstance(values, list) and all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in values)
    if not numbers or len(values) < width:
        there = " (there are {})".format(", ".join(map(str, known))[:100]) if known else ""
        found = "none" + there if values is None else "{} numbers".format(len(values)) if numbers else repr(values)[:80]
        problems.add(place, "{} numbers".format(width), found, "compute the data set's statistics again with openpi's script")
        return np.zeros(width, np.float32)
    with np.errstate(over="ignore"):  # reported below
        chosen = np.asarray(values[:width], np.float32)
    if not np.isfinite(chosen).all():
        problems.add(place, "finite numbers", str(chosen[~np.isfinite(chosen)][0]))
    elif name == "std" and (chosen < 0).any():
        problems.add(place, "numbers >= 0", str(chosen.min()))
    return chosen


def _openpi_features(robot: Robot, states: List[str], s: Sizes, checkpoint: Checkpoint, options: Options, problems: Problems) -> List[Key]:
    dims = {recipe.STATE: s.state_dim, recipe.ACTION: s.action_dim}
    names, aliases, optional = zip(*robot.views)
    views = views_of(["observation.images." + name for name in names], list(aliases), [int(flag) for flag in optional])
    widths = dict(zip(states, (width for _, width in robot.states)))
    return robot_keys(views, dims, options.dataset_info, checkpoint.notes, problems, states=widths)

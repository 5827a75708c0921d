# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The common parts of all LeRobot checkpoints: keys of config.json, features, views, the tokenizer's folder."""

from __future__ import annotations

import os
from typing import Callable, Dict, List, Sequence, Set, Tuple

from . import recipe
from .archs import Options
from .bundle import Key
from .checkpoint import Checkpoint
from .errors import Code, Problems, refuse
from .features import views_of
from .hub import HUB_FORM
from .section import Section

EMPTY_CAMERA = "observation.images.empty_camera_"
MAX_DIM, MAX_EMPTY = 1 << 16, 64
RTC_CONFIG = {"execution_horizon": 10, "prefix_attention_schedule": "LINEAR", "max_guidance_weight": 10.0}  # defaults of LeRobot's class
RTC_SCHEDULES = ("ZEROS", "ONES", "LINEAR", "EXP")
# Keys without effect on the numbers of an action chunk.
IGNORED = set(
    """
    type input_features output_features normalization_mapping rtc_config device use_amp push_to_hub repo_id
    private tags license pretrained_path pretrained_revision optimizer_lr optimizer_betas optimizer_eps
    optimizer_weight_decay optimizer_grad_clip_norm scheduler_warmup_steps scheduler_decay_steps
    scheduler_decay_lr compile_model compile_mode use_peft
    """.split()
)
# Keys with the only value that the runtime supports, and the reason.
FIXED = {"n_obs_steps": (1, "the reference reads one observation")}


def check_keys(policy: Section, name: str, known: Set[str], fixed: Dict[str, Tuple[object, str]]) -> None:
    """Refuses unknown keys of config.json, and values that the runtime does not support. `name`: the reference's class."""
    fixed = {key: value for key, value in {**FIXED, **fixed}.items() if key not in known}
    for key in sorted(set(policy.values) - known - set(fixed) - IGNORED):
        policy.bad(
            key,
            "a key of {} that this converter knows".format(name),
            hint="it may change numbers; a newer vla-convert may know it",
            unsupported=True,
        )
    for key, (value, hint) in fixed.items():
        policy.fixed(key, value, hint)
    if not _sound_rtc(policy.get("rtc_config")):
        expected = "none, or execution_horizon above 0, prefix_attention_schedule {} and max_guidance_weight above 0"
        policy.bad("rtc_config", expected.format(", ".join(RTC_SCHEDULES)))


def _sound_rtc(rtc) -> bool:
    """Whether an rtc_config is valid. Its `enabled` does not matter: without rows of a previous chunk the reference computes the same."""
    if not isinstance(rtc, dict):
        return rtc is None
    horizon, schedule, weight = (rtc.get(key, default) for key, default in RTC_CONFIG.items())
    is_weight = isinstance(weight, (int, float)) and not isinstance(weight, bool) and 0 < weight < 1e9
    return type(horizon) is int and 0 < horizon <= MAX_DIM and schedule in RTC_SCHEDULES and is_weight


def run_keys(checkpoint: Checkpoint, views: Sequence[str]) -> List[Key]:
    """Keys of how the checkpoint is run. They change no number of a chunk, only what a robot does with it."""
    config, keys = checkpoint.config, []
    steps, rtc = config.get("n_action_steps"), config.get("rtc_config")
    if type(steps) is int and 0 < steps <= MAX_DIM:
        keys.append(Key("action.n_action_steps", "u32", steps))
        told = "n_action_steps: the checkpoint executes {} of the {} rows of a chunk before it looks again"
        checkpoint.notes.append(told.format(steps, config.get("chunk_size", "?")))
    shapes = [(config.get("input_features", {}).get(view) or {}).get("shape") for view in views]
    sizes = [(shape[2], shape[1]) if isinstance(shape, list) and len(shape) == 3 else (0, 0) for shape in shapes]
    if any(sizes) and all(type(side) is int and 0 <= side <= MAX_DIM - 1 for size in sizes for side in size):
        keys.append(Key("observation.camera_sizes", "u32[]", [side for size in sizes for side in size]))
    if isinstance(rtc, dict) and _sound_rtc(rtc):
        horizon, schedule, weight = (rtc.get(key, default) for key, default in RTC_CONFIG.items())
        keys.append(Key("rtc.execution_horizon", "u32", horizon))
        keys.append(Key("rtc.schedule", "string", schedule.lower()))
        keys.append(Key("rtc.max_guidance", "f32", float(weight)))
    return keys


def no_position_rule(policy: Section, options: Options, problems: Problems) -> None:
    """Refuses --position-precision for an architecture with one position row per patch. Errors: usage."""
    if options.position_precision:
        found = "type {}".format(policy.get("type"))
        problems.add("--position-precision", "a SmolVLA checkpoint", found, "leave the option out", Code.USAGE)


def _features(policy: Section, key: str) -> dict:
    return policy.get(key) if isinstance(policy.get(key), dict) else {}


def listed_views(policy: Section, others: Callable[[str, object], None]) -> List[str]:
    """Names of the cameras that the config lists, in order. `others`: called with name and type of each feature of another kind."""
    views = []
    for name, feature in _features(policy, "input_features").items():
        kind, shape = (feature.get("type"), feature.get("shape")) if isinstance(feature, dict) else (None, None)
        if kind == "VISUAL":
            views.append(name)
            if not isinstance(shape, list) or len(shape) != 3 or shape[0] != 3:
                policy.bad("input_features." + name, "a frame of shape [3, height, width]", str(shape))
        elif name != recipe.STATE:
            others(name, kind)
    return views


def read_views(policy: Section, checkpoint: Checkpoint) -> Tuple[List[str], int]:
    """Names of the cameras in order, and the number of them that `empty_cameras` adds."""
    n_empty, note = policy.count("empty_cameras", 0, MAX_EMPTY), "input feature {} ({}): not read by this policy".format
    views = listed_views(policy, lambda name, kind: checkpoint.notes.append(note(name, kind)))
    if not views:
        policy.bad("input_features", "a VISUAL feature or several", "none")
    # The reference's config class adds these to the listed ones (validate_features).
    added = [EMPTY_CAMERA + str(i) for i in range(n_empty)]
    return views + [name for name in added if name not in views], n_empty


def strict_views(policy: Section) -> List[str]:
    """Names of the cameras. Refuses features that the reference does not read, since they may be misspelt."""
    expected = "cameras and {}".format(recipe.STATE)
    views = listed_views(policy, lambda name, kind: policy.bad("input_features." + name, expected, str(kind), unsupported=True))
    if not views:
        policy.bad("input_features", "a VISUAL feature or several", "none")
    return views


def vector_dim(policy: Section, key: str, name: str, kind: str) -> int:
    """Width of a state or action feature; `key`: input_features or output_features."""
    feature = _features(policy, key).get(name)
    shape = feature.get("shape") if isinstance(feature, dict) and feature.get("type") == kind else None
    if isinstance(shape, list) and len(shape) == 1 and isinstance(shape[0], int) and 0 < shape[0] <= MAX_DIM:
        return shape[0]
    policy.bad("{}.{}".format(key, name), "type {} and one dimension".format(kind), str(feature))
    return 1


def state_width(policy: Section, checkpoint: Checkpoint, options: Options, padded: bool = True) -> int:
    """Width of the state. The config of a fine-tune may still state the base's width: the reference never reads it if it pads the state
    (`padded`), but the statistics must have the robot's width."""
    return _width(policy, checkpoint, options, "input_features", recipe.STATE, "STATE", padded)


def action_width(policy: Section, checkpoint: Checkpoint, options: Options) -> int:
    """Width of the action. If the config contradicts the statistics, the reference fails to unnormalize, so only the user can decide."""
    return _width(policy, checkpoint, options, "output_features", recipe.ACTION, "ACTION", False)


def _width(policy: Section, checkpoint: Checkpoint, options: Options, key: str, name: str, kind: str, follows: bool) -> int:
    found = recipe.statistics_width(checkpoint, name, kind)
    if not found or options.widths == "config" or not (follows or options.widths):
        return vector_dim(policy, key, name, kind)
    stated = vector_dim(policy, key, name, kind) if name in _features(policy, key) else "none"
    if stated == found:
        return found
    if found == 1 and not options.widths:  # the reference broadcasts one number over a vector of any width
        return vector_dim(policy, key, name, kind)
    text = "{} has {} numbers, as its statistics do, and not the {} of config.json: {}"
    checkpoint.notes.append(text.format(name, found, stated, "--widths config would follow that" if follows else "--widths statistics"))
    return found


def check_widths(policy: Section, widths: Dict[str, Tuple[int, int]]) -> None:
    """Checks that padded widths suffice. `widths`: config key of the padded width -> (padded width, the feature's width)."""
    for key, (padded, real) in widths.items():
        if real > padded:
            policy.bad(key, "at least the feature's width {}".format(real))
    if policy.count("n_action_steps") > policy.count("chunk_size"):
        hint = "the reference refuses it too"
        policy.bad("n_action_steps", "at most chunk_size {}".format(policy.count("chunk_size")), hint=hint)


def view_keys(checkpoint: Checkpoint, views: Sequence[str], processors: recipe.Processors, problems: Problems) -> List[Key]:
    """Keys of the views, of which one must be present. Cameras that `empty_cameras` adds are in no data set, so they are optional: nobody
    needs to declare them absent."""
    empty = [view for view in views if view.startswith(EMPTY_CAMERA)]
    if empty:
        checkpoint.notes.append("views that stay empty unless a frame is given: " + ", ".join(empty))
    aliases = recipe.view_aliases(views, processors, checkpoint.notes, problems)
    return [*views_of(views, aliases, [int(view in empty) for view in views]), *run_keys(checkpoint, views)]


def required_view_keys(checkpoint: Checkpoint, views: Sequence[str], processors: recipe.Processors, problems: Problems) -> List[Key]:
    """Keys of the views for a policy whose reference needs every view."""
    aliases = recipe.view_aliases(views, processors, checkpoint.notes, problems)
    return [*views_of(views, aliases, [0] * len(views), len(views)), *run_keys(checkpoint, views)]


def tokenizer_folder(checkpoint: Checkpoint, options: Options, processors: recipe.Processors) -> str:
    """The folder of the checkpoint's own tokenizer: the one that the processor names, else tokenizer/ if it exists and --backbone is not
    given; else empty."""
    own = processors.own_tokenizer or ("" if options.backbone else "tokenizer")
    if not own or not (processors.own_tokenizer or os.path.exists(checkpoint.path(own))):
        return ""
    checkpoint.notes.append("tokenizer: from {}/ inside the checkpoint".format(own))
    return checkpoint.path(own)


def given_tokenizer(checkpoint: Checkpoint, options: Options, processors: recipe.Processors, name: str) -> str:
    """The folder of the checkpoint's own tokenizer or of --backbone, for a policy whose config names none. `name`: the reference's
    tokenizer. Errors: I/O."""
    found = tokenizer_folder(checkpoint, options, processors) or options.backbone
    if found:
        return found
    hint = "the reference takes that of {}, which --backbone {} fetches".format(name, HUB_FORM)
    raise refuse("tokenizer", "--backbone DIR, or tokenizer/ inside the checkpoint", "neither", hint, Code.IO)

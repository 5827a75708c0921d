# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Evo-1 as its authors save it: config.json, norm_stats.json, weights in a torch file. The code that served a checkpoint is part of its
meaning, and the checkpoint does not name it: what it leaves open is asked for, all of it at once.

Reference: MINT-SJTU/Evo-1, Evo_1/scripts/{Evo1_server,Evo1,train}.py, Evo_1/config.py, Evo_1/model. An absent key means the default of
its EvoConfig, which is stated here beside the key.
"""

from __future__ import annotations

import os
from typing import Dict, List, NamedTuple, Sequence, Tuple

import numpy as np

from .. import recipe
from ..bundle import Key
from ..checkpoint import NORM_STATS, Checkpoint, find_backbone
from ..errors import Code, Problems
from ..features import feature_keys
from ..files import read_json
from ..section import Section
from . import Options
from ._evo1_names import AUTHORS
from ._evo1_sizes import Sizes, check_fixed, check_head, read_chat_backbone
from ._evo1_source import Source, image_ops, pad_op

WIDTH = 24  # of states and actions on their way to the network: a literal of the server
EPS = 1e-8
MAX_SLOTS = 32
DIMS_FILE, DIMS = "dims.json", {"language_layers": 14, "prompt_tokens": 1024}  # literals of the embedder
DOCS = "docs/converting.md, Evo-1"
MEANINGS = {
    "--variant": "the authors' code before 9 April 2026 takes other steps, times, pixels and paddings than the code since, and a policy"
    " is served by the one that it was made for: go by the date of the upload, or by what config.json holds",
    "--stats": "the robot and the data set whose numbers the policy sees; the authors' server gets both names from its client",
    "--view-slots": "the prompt has a slot for every picture of a request, black ones too, and the authors' server takes exactly 3",
    "--views": "names of the cameras in the order in which the client sends their pictures; slots behind them stay masked",
    "--dead-rows": "the action head reads masked rows too, and flash-attention leaves zeros in them where other attention does not:"
    " zero_attention where flash-attn was installed, as the authors ask for, causal_attention where it was not",
}


class Revision(NamedTuple):
    """What the server of one revision does, whatever config.json says."""

    n_step: int
    time_scale: float
    arithmetic: str
    pad: float  # the number in state columns that the robot does not have


REVISIONS = {
    "r1": Revision(32, 1000.0, "float32_then_bfloat16", -1.0),
    "r2": Revision(50, 999.0, "bfloat16", 0.0),
}
CONFIG = {
    "vlm_name": "OpenGVLab/InternVL3-1B",
    "horizon": 16,
    "action_horizon": None,
    "embed_dim": 896,
    "hidden_dim": 1024,
    "state_hidden_dim": 1024,
    "num_heads": 8,
    "num_layers": 8,
    "normalization_type": "bounds",
}
FIXED = {
    "per_action_dim": (7, WIDTH),
    "state_dim": (7, WIDTH),
    "num_categories": (1, 1),
    "return_cls_only": (False, False),
    "action_head": ("flowmatching", "flowmatching"),
}
# Keys of training and of logging, of either revision. The server counts its own steps and resizes to the embedder's own size.
IGNORED = set(
    """
    device run_name disable_wandb wandb_project debug dataset_type data_paths dataset_config_path image_size binarize_gripper
    use_augmentation vision_masked max_samples_per_file video_backend cache_dir lr batch_size num_workers prefetch_factor pin_memory
    persistent_workers max_steps warmup_steps grad_clip_norm weight_decay fused_adamw non_finite_max_streak log_interval
    ckpt_interval save_dir enable_gradient_checkpointing gradient_checkpointing_use_reentrant resume resume_path resume_pretrain
    finetune_vlm finetune_language_model finetune_vision_model finetune_action_head dropout num_inference_timesteps action_dim
    """.split()
)
# normalization_type -> the recipe's kind, the statistics that it reads, and whether a state is held in [-1, 1]
KINDS = {
    "bounds": ("evo1_min_max", ("min", "max"), True),
    "bounds_q99": ("evo1_quantiles", ("q01", "q99"), True),
    "normal": ("evo1_mean_std", ("mean", "std"), False),
}


def read_authors(checkpoint: Checkpoint, options: Options, problems: Problems) -> Source:
    stats = _find_statistics(checkpoint, options, problems)
    _check_answers(options, problems)
    problems.raise_any()
    policy = Section("config.json", checkpoint.config, CONFIG, problems)
    sizes = _sizes(policy, checkpoint, options)
    folder = find_backbone(checkpoint, options.backbone, policy.get("vlm_name"), "vlm_name")
    read_chat_backbone(read_json(os.path.join(folder, "config.json")), sizes, problems)
    sizes.n_layer = min(sizes.n_layer, sizes.n_backbone_layer)
    check_head(policy, sizes, policy.count("embed_dim"))
    revision = REVISIONS[options.variant]
    kind = _kind(policy, options.variant)
    state, clip = _normalization(recipe.STATE, "normalize", kind, stats, checkpoint, problems)
    action, _ = _normalization(recipe.ACTION, "unnormalize", kind, stats, checkpoint, problems)
    sizes.state_dim, sizes.action_dim = _width(state.statistics), _width(action.statistics)
    sizes.d_robot = sizes.action_dim
    if options.variant == "r2" and "action_dim" in policy.values:
        checkpoint.notes.append("config.json has action_dim, which the code of r1 writes and that of r2 does not: is it --variant r1?")
    checkpoint.notes.append("the robot's {} action columns are those that {} has numbers for".format(sizes.d_robot, NORM_STATS))
    return Source(
        sizes=sizes,
        names=AUTHORS,
        tokenizer=folder,
        image_token=None,
        image=image_ops(sizes.image_size, "opencv_bilinear", revision.arithmetic),
        state=[state.op, *([{"op": "clip", "low": -1.0, "high": 1.0}] if clip else []), pad_op(WIDTH, revision.pad)],
        action=[{"op": "take", "size": sizes.action_dim}, action.op],
        features=_features(checkpoint, options, sizes, problems),
        statistics={**state.statistics, **action.statistics},
    )


def _ask(problems: Problems, flag: str, expected: str, found: str) -> None:
    problems.add(flag, expected, found or "none", "{} ({})".format(MEANINGS[flag], DOCS), Code.USAGE)


def _check_answers(options: Options, problems: Problems) -> None:
    if options.variant not in REVISIONS:
        _ask(problems, "--variant", "r1 or r2, a revision of the authors' code", options.variant)
    n_slot, views = options.view_slots, [_view_name(name) for name in options.views]
    if not 1 <= n_slot <= MAX_SLOTS:
        _ask(problems, "--view-slots", "a count from 1 to {}".format(MAX_SLOTS), str(n_slot or ""))
    if not views or len(set(views)) != len(views) or "" in options.views or (n_slot and len(views) > n_slot):
        _ask(problems, "--views", "different names, no more than there are slots", ",".join(options.views))
    if options.dead_rows not in ("zero_attention", "causal_attention"):
        _ask(problems, "--dead-rows", "zero_attention or causal_attention", options.dead_rows)


def _find_statistics(checkpoint: Checkpoint, options: Options, problems: Problems) -> dict:
    """One entry of norm_stats.json: under an arm and a data set, or under the arm alone, as older files have it."""
    entries: Dict[str, dict] = {}
    for arm, value in read_json(checkpoint.path(NORM_STATS)).items():
        inner = value if isinstance(value, dict) else {}
        if recipe.STATE in inner or recipe.ACTION in inner:
            entries[arm] = inner
        else:
            entries.update(("{}/{}".format(arm, name), stats) for name, stats in inner.items() if isinstance(stats, dict))
    if options.stats in entries:
        return entries[options.stats]
    if len(entries) == 1 and not options.stats:
        return next(iter(entries.values()))
    _ask(problems, "--stats", "one of the entries of {}: {}".format(NORM_STATS, ", ".join(entries) or "none"), options.stats)
    return {}


def _sizes(policy: Section, checkpoint: Checkpoint, options: Options) -> Sizes:
    for key in sorted(set(policy.values) - set(CONFIG) - set(FIXED) - IGNORED):
        hint = "it may change numbers; a newer vla-convert may know it"
        policy.bad(key, "a key of EvoConfig that this converter knows", hint=hint, unsupported=True)
    check_fixed(policy, FIXED)
    if policy.get("action_horizon") not in (None, policy.get("horizon")):
        policy.bad("action_horizon", "horizon {}, or none".format(policy.get("horizon")))
    revision, dims = REVISIONS[options.variant], _dims(checkpoint, policy.problems)
    return Sizes(
        n_layer=dims.count("language_layers", most=1024),
        n_token=dims.count("prompt_tokens"),
        n_head_layer=policy.count("num_layers", most=1024),
        n_head_head=policy.count("num_heads"),
        d_hidden=policy.count("hidden_dim"),
        d_state_hidden=policy.count("state_hidden_dim"),
        d_state=WIDTH,
        d_action=WIDTH,
        horizon=policy.count("horizon"),
        n_slot=options.view_slots,
        n_step=revision.n_step,
        time_scale=revision.time_scale,
        dead_rows=options.dead_rows,
        absent_views="in_place",
    )


def _dims(checkpoint: Checkpoint, problems: Problems) -> Section:
    """Two literals of the embedder, for checkpoints of other sizes than the published."""
    path = checkpoint.path(DIMS_FILE)
    dims = Section(DIMS_FILE, read_json(path) if os.path.exists(path) else {}, DIMS, problems)
    for key in sorted(set(dims.values) - set(DIMS)):
        dims.bad(key, " or ".join(DIMS), unsupported=True)
    return dims


def _kind(policy: Section, variant: str) -> str:
    kind = policy.get("normalization_type")
    if not isinstance(kind, str) or kind not in KINDS:
        policy.bad("normalization_type", " or ".join(KINDS), unsupported=True)
        return "bounds"
    if variant == "r1" and kind != "bounds":
        policy.bad("normalization_type", "bounds, or no such key: the server of r1 knows no other", hint="--variant r2 has the others")
    return kind


class _Normalized(NamedTuple):
    op: dict
    statistics: Dict[str, np.ndarray]


def _normalization(
    feature: str, op: str, name: str, stats: dict, checkpoint: Checkpoint, problems: Problems
) -> Tuple[_Normalized, bool]:
    """The op with its statistics, and whether it is followed by a clip."""
    kind, names, clip = KINDS[name]
    stated = stats.get(feature) if isinstance(stats.get(feature), dict) else {}
    if name == "bounds_q99" and any(stated.get(n) is None for n in names):
        kind, names, clip = KINDS["bounds"]
        checkpoint.notes.append("{}: no q01 and q99 for {}, so min and max count, as in the reference".format(NORM_STATS, feature))
    values = {n: _numbers("{}: {}.{}".format(NORM_STATS, feature, n), stated.get(n), n, problems) for n in names}
    if len({v.size for v in values.values()}) != 1:
        problems.add("{}: {}".format(NORM_STATS, feature), "lists of one length", str({n: v.size for n, v in values.items()}))
    where = "stats." + feature
    statistics = {"{}.{}".format(where, n): v for n, v in values.items()}
    return _Normalized({"op": op, "kind": kind, "stats": where, "eps": EPS}, statistics), clip


def _numbers(where: str, values, name: str, problems: Problems) -> np.ndarray:
    numbers = isinstance(values, list) and all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in values)
    if not numbers or not 1 <= len(values) <= WIDTH:
        found = "none" if values is None else "{} numbers".format(len(values)) if numbers else str(type(values).__name__)
        problems.add(where, "1 to {} numbers".format(WIDTH), found)
        return np.zeros(1, np.float32)
    with np.errstate(over="ignore"):  # told below
        chosen = np.asarray(values, np.float64).astype(np.float32)
    if not np.isfinite(chosen).all():
        problems.add(where, "finite numbers", str(chosen[~np.isfinite(chosen)][0]))
    elif name == "std" and (chosen < 0).any():
        problems.add(where, "numbers >= 0", str(chosen.min()))
    return chosen


def _width(statistics: Dict[str, np.ndarray]) -> int:
    return next(iter(statistics.values())).size


def _view_name(name: str) -> str:
    return name if name.startswith("observation.images.") else "observation.images." + name


def _features(checkpoint: Checkpoint, options: Options, s: Sizes, problems: Problems) -> List[Key]:
    """Every view may stay away: its slot is masked, as a client of the reference masks the pictures that it does not have."""
    views: Sequence[str] = [_view_name(name) for name in options.views]
    dims = {recipe.STATE: s.state_dim, recipe.ACTION: s.action_dim}
    return [
        Key("observation.views", "string[]", views),
        Key("observation.view_aliases", "string[]", [""] * len(views)),
        # The server gets an image for every slot, and the client says which of them are none: nothing is absent by silence.
        Key("observation.view_optional", "u32[]", [0] * len(views)),
        Key("observation.min_views", "u32", 1),
        Key("observation.states", "string[]", [recipe.STATE]),
        Key("observation.state_dims", "u32[]", [s.state_dim]),
        *feature_keys(options.dataset_info, dims, checkpoint.notes, problems),
    ]

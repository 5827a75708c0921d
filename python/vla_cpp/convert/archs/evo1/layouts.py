# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The two layouts of Evo-1.

The authors' layout: config.json, norm_stats.json, weights in a torch file. The meaning of a checkpoint depends on the code that served it,
which the checkpoint does not name; options state what is missing, and all missing options are reported together.

Reference: MINT-SJTU/Evo-1, Evo_1/scripts/{Evo1_server,Evo1,train}.py, Evo_1/config.py, Evo_1/model. An absent key has the default of
the reference's EvoConfig, listed here with the key.

LeRobot's layout: config.json and the two processor pipelines.

Reference: lerobot src/lerobot/policies/evo1 (configuration, processor, modeling, internvl3_embedder). An absent key has the
default of Evo1Config, listed here with the key.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Dict, List, NamedTuple, Tuple

import numpy as np

from ... import recipe
from ...bundle import Key
from ...checkpoint import Checkpoint, Layout, Tensors, find_backbone
from ...errors import Code, Problems, refuse
from ...features import robot_keys, view_name, views_of
from ...files import member, read_json
from ...images import IMAGENET
from ...lerobot import check_keys, check_widths, no_position_rule, read_views, run_keys, vector_dim
from ...networks import MAX_LAYERS
from ...normalization import Normalization
from ...options import Option, stats, variant, views
from ...section import Section
from ...torch_file import read_torch
from .. import Options
from .mapping import AUTHORS, LEROBOT, Sizes, Spelling, check_head, read_chat_backbone, read_hf_backbone


@dataclass
class Source:
    sizes: Sizes
    names: Spelling
    tokenizer: str  # folder of the tokenizer
    image_token: object  # the image token's id in the backbone's config; None if it states none
    image: List[dict]
    state: List[dict]
    action: List[dict]
    features: List[Key]
    statistics: Dict[str, np.ndarray]


def image_ops(side: int, filter_name: str, arithmetic: str) -> List[dict]:
    """The recipe's image ops. Both references contain the statistics as literals."""
    return [
        {"op": "resize", "width": side, "height": side, "filter": filter_name},
        {"op": "standardize", **IMAGENET, "arithmetic": arithmetic},
    ]


def pad_op(size: int, value: float) -> dict:
    return {"op": "pad", "size": size, **({"value": value} if value else {})}


# --- the authors' layout ---------------------------------------------------------------------------------------------------------------

# Files of the trainer, with and without DeepSpeed -> the member with the policy's tensors.
TORCH_FILES = {"mp_rank_00_model_states.pt": "module", "checkpoint.pt": "model_state_dict"}
NORM_STATS = "norm_stats.json"


def _read_tensors(folder: str, _problems: Problems) -> Tensors:
    present = [name for name in TORCH_FILES if os.path.exists(os.path.join(folder, name))]
    if len(present) != 1:
        found, code = ("no such file", Code.IO) if not present else ("both", Code.BAD_BUNDLE)
        raise refuse(folder, "either " + " or ".join(TORCH_FILES), found, "give the folder of one training step", code)
    return read_torch(os.path.join(folder, present[0]), TORCH_FILES[present[0]]), {}


LAYOUT = Layout(
    "Evo-1's authors",
    (
        variant("the revision of their code, r1 or r2"),
        stats("ARM/DATASET, the entry of norm_stats.json to normalize with, where there are several"),
        views("names of the cameras, in the order of the prompt's view slots"),
        Option("--max-views", "view slots of the prompt; the authors' server has 3", "N", 0, read=int),
        Option(
            "--masked-rows",
            "what attention wrote into masked rows, which the action head reads: zeros with flash-attn",
            choices=("zero_attention", "causal_attention"),
        ),
    ),
    files=(*TORCH_FILES, NORM_STATS),
    read=_read_tensors,
    about="""\
A checkpoint of Evo-1's authors needs --variant, --views, --max-views and --masked-rows: r1 is their code before 9 April 2026, r2 the
code since (steps, time index, pixel rounding and state padding differ); --masked-rows is zero_attention if the policy ran with
flash-attn, which the authors ask for. docs/converting.md tells how to find out.""",
)

WIDTH = 24  # padded width of states and actions, a literal of the server
EPS = 1e-8
MAX_SLOTS = 32
DIMS_FILE, DIMS = "dims.json", {"language_layers": 14, "prompt_tokens": 1024}  # defaults are literals of the embedder
DOCS = "docs/converting.md, Evo-1"
MEANINGS = {
    "--variant": "the authors' code before 9 April 2026 takes other steps, times, pixels and paddings than the code since, and a policy"
    " is served by the one that it was made for: go by the date of the upload, or by what config.json holds",
    "--stats": "the robot and the data set whose numbers the policy sees; the authors' server gets both names from its client",
    "--max-views": "the prompt has a slot for every image of a request, black ones too, and the authors' server takes exactly 3",
    "--views": "names of the cameras in the order in which the client sends their images; slots behind them stay masked",
    "--masked-rows": "the action head reads masked rows too, and flash-attention leaves zeros in them where other attention does not:"
    " zero_attention where flash-attn was installed, as the authors ask for, causal_attention where it was not",
}


class Revision(NamedTuple):
    """Settings that are fixed in one revision of the server, whatever config.json says."""

    n_step: int
    time_scale: float
    arithmetic: str
    pad: float  # value of padded state columns


REVISIONS = {"r1": Revision(32, 1000.0, "float32_then_bfloat16", -1.0), "r2": Revision(50, 999.0, "bfloat16", 0.0)}
AUTHORS_CONFIG = {
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
AUTHORS_FIXED = {
    "per_action_dim": (7, WIDTH),
    "state_dim": (7, WIDTH),
    "num_categories": (1, 1),
    "return_cls_only": (False, False),
    "action_head": ("flowmatching", "flowmatching"),
}
# Keys of training and logging in either revision. The server has its own number of steps and resizes to the embedder's size.
AUTHORS_IGNORED = set(
    """
    device run_name disable_wandb wandb_project debug dataset_type data_paths dataset_config_path image_size binarize_gripper
    use_augmentation vision_masked max_samples_per_file video_backend cache_dir lr batch_size num_workers prefetch_factor pin_memory
    persistent_workers max_steps warmup_steps grad_clip_norm weight_decay fused_adamw non_finite_max_streak log_interval
    ckpt_interval save_dir enable_gradient_checkpointing gradient_checkpointing_use_reentrant resume resume_path resume_pretrain
    finetune_vlm finetune_language_model finetune_vision_model finetune_action_head dropout num_inference_timesteps action_dim
    """.split()
)
# normalization_type -> the recipe's kind, the statistics that it reads, and whether a state is clipped to [-1, 1]
KINDS = {
    "bounds": ("evo1_min_max", ("min", "max"), True),
    "bounds_q99": ("evo1_quantiles", ("q01", "q99"), True),
    "normal": ("evo1_mean_std", ("mean", "std"), False),
}


def read_authors(checkpoint: Checkpoint, options: Options, problems: Problems) -> Source:
    stats = _find_statistics(checkpoint, options, problems)
    _check_answers(options, problems)
    problems.raise_any()
    policy = Section("config.json", checkpoint.config, AUTHORS_CONFIG, problems)
    sizes = _authors_sizes(policy, checkpoint, options)
    folder = find_backbone(checkpoint, options.backbone, policy.get("vlm_name"), "vlm_name")
    read_chat_backbone(read_json(os.path.join(folder, "config.json")), sizes, problems)
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
        image=image_ops(sizes.vision.image_size, "opencv_bilinear", revision.arithmetic),
        state=[state.op, *([{"op": "clip", "low": -1.0, "high": 1.0}] if clip else []), pad_op(WIDTH, revision.pad)],
        action=[{"op": "take", "size": sizes.action_dim}, action.op],
        features=_authors_features(checkpoint, options, sizes, problems),
        statistics={**state.statistics, **action.statistics},
    )


def _ask(problems: Problems, flag: str, expected: str, found: str) -> None:
    problems.add(flag, expected, found or "none", "{} ({})".format(MEANINGS[flag], DOCS), Code.USAGE)


def _check_answers(options: Options, problems: Problems) -> None:
    if options.variant not in REVISIONS:
        _ask(problems, "--variant", "r1 or r2, a revision of the authors' code", options.variant)
    max_views, views = options.max_views, [view_name(name) for name in options.views]
    if not 1 <= max_views <= MAX_SLOTS:
        _ask(problems, "--max-views", "a count from 1 to {}".format(MAX_SLOTS), str(max_views or ""))
    if not views or len(set(views)) != len(views) or "" in options.views or (max_views and len(views) > max_views):
        _ask(problems, "--views", "different names, no more than there are slots", ",".join(options.views))
    if options.masked_rows not in ("zero_attention", "causal_attention"):
        _ask(problems, "--masked-rows", "zero_attention or causal_attention", options.masked_rows)


def _find_statistics(checkpoint: Checkpoint, options: Options, problems: Problems) -> dict:
    """One entry of norm_stats.json, stored by arm and data set, or in older files by arm alone."""
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


def _authors_sizes(policy: Section, checkpoint: Checkpoint, options: Options) -> Sizes:
    for key in sorted(set(policy.values) - set(AUTHORS_CONFIG) - set(AUTHORS_FIXED) - AUTHORS_IGNORED):
        hint = "it may change numbers; a newer vla-convert may know it"
        policy.bad(key, "a key of EvoConfig that this converter knows", hint=hint, unsupported=True)
    policy.check_fixed(AUTHORS_FIXED)
    if policy.get("action_horizon") not in (None, policy.get("horizon")):
        policy.bad("action_horizon", "horizon {}, or none".format(policy.get("horizon")))
    revision, dims = REVISIONS[options.variant], _dims(checkpoint, policy.problems)
    return Sizes(
        n_layer=dims.count("language_layers", maximum=MAX_LAYERS),
        n_token=dims.count("prompt_tokens"),
        n_head_layer=policy.count("num_layers", maximum=MAX_LAYERS),
        n_head_head=policy.count("num_heads"),
        d_hidden=policy.count("hidden_dim"),
        d_state_hidden=policy.count("state_hidden_dim"),
        d_state=WIDTH,
        d_action=WIDTH,
        horizon=policy.count("horizon"),
        max_views=options.max_views,
        n_step=revision.n_step,
        time_scale=revision.time_scale,
        masked_rows=options.masked_rows,
        absent_views="in_place",
    )


def _dims(checkpoint: Checkpoint, problems: Problems) -> Section:
    """The sizes in dims.json, which replace two literals of the embedder for checkpoints of unpublished sizes."""
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


def _normalization(feature: str, op: str, name: str, stats: dict, checkpoint: Checkpoint, problems: Problems) -> Tuple[_Normalized, bool]:
    """The op with its statistics, and whether a clip follows."""
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
    with np.errstate(over="ignore"):  # reported below
        chosen = np.asarray(values, np.float64).astype(np.float32)
    if not np.isfinite(chosen).all():
        problems.add(where, "finite numbers", str(chosen[~np.isfinite(chosen)][0]))
    elif name == "std" and (chosen < 0).any():
        problems.add(where, "numbers >= 0", str(chosen.min()))
    return chosen


def _width(statistics: Dict[str, np.ndarray]) -> int:
    return next(iter(statistics.values())).size


def _authors_features(checkpoint: Checkpoint, options: Options, s: Sizes, problems: Problems) -> List[Key]:
    """Keys of views, states and actions. Any view may be declared absent: its slot is masked, as a client of the reference masks missing
    images."""
    names = [view_name(name) for name in options.views]
    # The reference's client sends an image and a mask for every slot, so an absent view must be declared.
    views = views_of(names, [""] * len(names), [0] * len(names))
    return robot_keys(views, {recipe.STATE: s.state_dim, recipe.ACTION: s.action_dim}, options.dataset_info, checkpoint.notes, problems)


# --- LeRobot's layout ------------------------------------------------------------------------------------------------------------------

LEROBOT_CONFIG = {
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
LEROBOT_FIXED = {"action_head": ("flowmatching", "flowmatching"), "num_categories": (1, 1), "return_cls_only": (False, False)}
# Keys without effect on the numbers of an action chunk.
LEROBOT_IGNORED = set(
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
        "evo1_pad_action_processor": {"max_action_dim": recipe.ANY},  # only training uses it
    },
    recipe.POST: {ACTION_STEP: {key: recipe.ANY for key in ("action_dim", *GRIPPER)}},
}
# Values with which the reference pads statistics to the padded width (_STAT_PAD_VALUES).
NEUTRAL = {"mean": 0.0, "std": 1.0, "min": -1.0, "max": 1.0, "q01": -1.0, "q99": 1.0, "q10": -1.0, "q90": 1.0}


def read_lerobot(checkpoint: Checkpoint, options: Options, problems: Problems) -> Source:
    policy = Section("config.json", checkpoint.config, {**LEROBOT_CONFIG, **GRIPPER}, problems)
    no_position_rule(policy, options, problems)
    check_keys(policy, "Evo1Config", set(LEROBOT_CONFIG) | set(GRIPPER) | set(LEROBOT_FIXED) | LEROBOT_IGNORED, {})
    policy.check_fixed(LEROBOT_FIXED)
    sizes = _lerobot_sizes(policy)
    views, n_empty = read_views(policy, checkpoint)
    if len(views) > sizes.max_views:
        policy.bad("max_views", "at least the {} cameras".format(len(views)), hint="the reference refuses it too")
    folder = find_backbone(checkpoint, options.backbone, policy.get("vlm_model_name"))
    backbone = read_json(os.path.join(folder, "config.json"))
    read_hf_backbone(backbone, sizes, problems)
    if policy.get("image_resolution") != [sizes.vision.image_size] * 2:
        policy.bad("image_resolution", "the tower's {0} x {0}".format(sizes.vision.image_size), hint="the reference refuses it too")
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
        image=image_ops(sizes.vision.image_size, "torch_bicubic_8bit", str(arithmetic)),
        state=[*processors.state.op("normalize", recipe.STATE), pad_op(sizes.d_state, pad)],
        action=[
            {"op": "take", "size": sizes.action_dim},
            *processors.action.op("unnormalize", recipe.ACTION),
            *_gripper(policy, sizes.action_dim),
        ],
        features=robot_keys(
            _view_keys(views, n_empty, processors, checkpoint, problems), dims, options.dataset_info, checkpoint.notes, problems
        ),
        statistics=processors.statistics(),
    )


def _lerobot_sizes(policy: Section) -> Sizes:
    """The sizes in the config. A state or action that it does not list has the padded width (Evo1Config.validate_features)."""
    s = Sizes(
        n_layer=policy.count("vlm_num_layers", maximum=MAX_LAYERS) if policy.get("vlm_num_layers") is not None else MAX_LAYERS,
        n_token=policy.count("max_text_length"),
        n_head_layer=policy.count("num_layers", maximum=MAX_LAYERS),
        n_head_head=policy.count("num_heads"),
        d_hidden=policy.count("hidden_dim"),
        d_state_hidden=policy.count("state_hidden_dim"),
        d_state=policy.count("max_state_dim"),
        d_action=policy.count("max_action_dim"),
        horizon=policy.count("chunk_size"),
        max_views=policy.count("max_views", maximum=32),
        n_step=policy.count("num_inference_timesteps"),
        time_scale=999.0,
        masked_rows="unseen",
        absent_views="last",
    )
    s.state_dim, s.d_robot = s.d_state, s.d_action
    if recipe.STATE in member(policy.values, "input_features", dict, "config.json"):
        s.state_dim = vector_dim(policy, "input_features", recipe.STATE, "STATE")
    if recipe.ACTION in member(policy.values, "output_features", dict, "config.json"):
        s.d_robot = vector_dim(policy, "output_features", recipe.ACTION, "ACTION")
    check_widths(policy, {"max_state_dim": (s.d_state, s.state_dim), "max_action_dim": (s.d_action, s.d_robot)})
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
    min_widths = {recipe.STATE: s.state_dim, recipe.ACTION: s.d_robot}
    processors = recipe.read_processors(checkpoint, dims, options.identity_stats, problems, STEPS, min_widths)
    problems.raise_any()
    pre, post = (
        [(step.get("registry_name", step.get("class")), step.get("config", {})) for step in file["steps"]] for file in checkpoint.processors
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
        # The reference rebuilds this step from config.json, so the pipeline's file must agree with it.
        stated = {"action_dim": s.action_dim, **{key: policy.get(key) for key in GRIPPER}}
        for key, value in configs[ACTION_STEP].items():
            if value != stated[key]:
                problems.add("{}: {}".format(recipe.POST, key), "{!r} as config.json has it".format(stated[key]), repr(value))
    return processors


def _pad_value(norm: Normalization, s: Sizes, problems: Problems) -> float:
    """The normalized value of padded state columns. The reference first appends zeros to the state and then normalizes all columns; padded
    columns have neutral statistics unless the file has others for them."""
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
    """The values of normalize_processor.py's formulas at 0, in float32."""
    if not stats:
        return np.zeros(0, np.float32)
    eps = np.float32(norm.eps)
    if norm.kind == "mean_std":
        return (np.float32(0) - stats["mean"]) / (stats["std"] + eps)
    low, high = stats.values()  # in the order of MODES
    span = high - low
    return np.float32(2) * (np.float32(0) - low) / np.where(span == 0, eps, span) - np.float32(1)


def _gripper(policy: Section, width: int) -> List[dict]:
    if policy.get("binarize_gripper") is False:
        return []
    if policy.get("binarize_gripper") is not True:
        policy.bad("binarize_gripper", "true or false")
    column = policy.count("gripper_index", minimum=0)
    if column >= width:
        policy.bad("gripper_index", "a column of the action, below {}".format(width), hint="the reference refuses it too")
    above, high, low = (
        policy.number("gripper_" + name, above=-1e30) for name in ("threshold", "above_threshold_value", "below_threshold_value")
    )
    return [{"op": "threshold", "columns": [column], "above": above, "then": high, "else": low}]


def _view_keys(views: List[str], n_empty: int, processors: recipe.Processors, checkpoint: Checkpoint, problems: Problems) -> List[Key]:
    """Keys of the views. As in the reference, up to `empty_cameras` cameras, of any names, may be left out and are then absent."""
    aliases = recipe.view_aliases(views, processors, checkpoint.notes, problems)
    return [*views_of(views, aliases, [1] * len(views), max(1, len(views) - n_empty)), *run_keys(checkpoint, views)]

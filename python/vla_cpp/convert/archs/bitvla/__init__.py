# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""BitVLA: a SigLIP tower and BitNet b1.58, both of ternary weights, that fill the slots of a whole chunk in one pass, and an MLP-ResNet.

A fine-tune is a folder: config.json, bfloat16 master weights, tokenizer and processor files, dataset_statistics.json, and the action head
and the proprio projector in a file of torch.save each. The robot is a set of constants in their code, chosen by the command line of
a training run; the widths of head and projector identify it.

Reference: ustcwhy/BitVLA openvla-oft (experiments/robot/{bitnet_utils,openvla_utils,robot_utils}.py, prismatic/vla/constants.py,
bitvla/bitnet_action_tokenizer.py, convert_ckpt.py).
"""

from __future__ import annotations

import os
import re
from typing import Dict, List, Tuple

import numpy as np

from ... import recipe
from ...ascii_bpe import Encoder, check_undivided, special_ids
from ...bundle import Key
from ...checkpoint import Checkpoint, Layout, Tensors, read_stored
from ...errors import Problems, refuse
from ...features import robot_keys, view_name, views_of
from ...files import member, read_json, read_text
from ...options import Option, stats, views
from ...section import Fixed, Section
from ...tokenizer import TokenizerPlan, read_tokenizer
from ...torch_file import read_torch
from .. import Options, Plan
from .mapping import HEAD, PROPRIO, Sizes, dropped, network_keys, read_sizes, weights

STATISTICS, PROCESSOR, IMAGES = "dataset_statistics.json", "processor_config.json", "preprocessor_config.json"
# What the trainer writes beside the language model, each with the step in its name.
SIDECARS = ("action_head", "proprio_projector")
HORIZONS = {(8, 7): 8}  # of LIBERO, by numbers of states and actions
GRIPPER = 6  # from 0, closed, to 1, open; LIBERO's simulator opens it by -1
CROP, EPS, JPEG_QUALITY = 0.9, 1e-8, 95
VIEWS, ALIASES = ("image", "image2"), ("full_image", "wrist_image")  # LeRobot's names of LIBERO's cameras, and the reference's
BOS, STOP, END, IMAGE, STATE = "<|begin_of_text|>", "<|end_of_text|>", "<|eot_id|>", "<|image_pad|>", "<proprio_pad>"
QUESTION = "What action should the robot take to {instruction}?"
# What convert_ckpt.py puts behind the system's sentence: one message of a user, and the start of the assistant's.
TEMPLATE = (
    "{% set loop_messages = messages %}{% for message in loop_messages %}{% set content = message['role'] | capitalize + ': '"
    "+ message['content'] | trim + '<|eot_id|>' %}{{ content }}{% endfor %}{% if add_generation_prompt %}{{ 'Assistant: ' }}{% endif %}"
)
N_INSTRUCTION = 512  # tokens, far above any instruction: the reference cuts none
IMAGES_FIXED: Fixed = {
    "do_resize": (True, True),
    "do_rescale": (True, True),
    "do_normalize": (True, True),
    "rescale_factor": (1 / 255, 1 / 255),
    "image_mean": ([0.5] * 3, [0.5] * 3),
    "image_std": ([0.5] * 3, [0.5] * 3),
}
IMAGES_IGNORED = {"do_convert_rgb", "image_processor_type", "processor_class", "resample", "size", "_valid_processor_keys"}
PROCESSOR_IGNORED = {"processor_class", "num_additional_image_tokens", "vision_feature_select_strategy"}


def plan(checkpoint: Checkpoint, options: Options, problems: Problems) -> Plan:
    s = read_sizes(checkpoint.config, problems)
    views = list(options.views) or list(VIEWS)
    s.max_views = len(views)
    _read_robot(checkpoint, s, problems)
    problems.raise_any()
    statistics, mask = _statistics(checkpoint, options.stats, s, problems)
    _check_images(checkpoint, s, problems)
    tokenizer = read_tokenizer(checkpoint.folder, s.lm.n_vocab, problems, checkpoint.notes)
    problems.raise_any()  # a prompt takes a sound tokenizer
    text, prompt_keys = _prompt(checkpoint, tokenizer, s, problems)
    normal = {"kind": "openpi_quantiles", "eps": EPS}  # the same formula, on statistics in float64
    document = {
        "image": image_ops(s.vision.image_size, options.plain_images),
        "text": text,
        "state": [
            {"op": "normalize", "stats": "stats." + recipe.STATE, **normal},
            {"op": "clip", "low": -1.0, "high": 1.0},
            {"op": "pad", "size": s.d_state},
        ],
        "action": [
            {"op": "unnormalize", "stats": "stats." + recipe.ACTION, **normal, "columns": [i for i, on in enumerate(mask) if on]},
            {"op": "affine", "columns": [GRIPPER], "scale": -2.0, "shift": 1.0},
            {"op": "sign", "columns": [GRIPPER]},
        ],
    }
    keys = [
        *network_keys(s),
        *prompt_keys,
        *_features(views, options, checkpoint.notes, s, problems),
        *tokenizer.keys,
        recipe.recipe_key(document),
    ]
    problems.raise_any()
    return Plan(keys, weights(s), dropped(s), statistics)


def image_ops(side: int, plain: bool) -> List[dict]:
    """From the camera's image, turned by 180 degrees as LIBERO's clients do. The reference passes it through a JPEG first
    (openvla_utils.py, resize_image_for_policy), as the data were that it was trained on; `plain`: not that."""
    size = {"width": side, "height": side}
    half = [0.5] * 3
    return [
        *([] if plain else [{"op": "jpeg", "quality": JPEG_QUALITY}]),
        {"op": "lanczos3", **size},
        {"op": "crop_and_resize", "area": CROP, **size},
        {"op": "size", **size},
        {"op": "standardize", "mean": half, "std": half, "arithmetic": "float32_then_bfloat16"},
    ]


def _read_tensors(folder: str, problems: Problems) -> Tensors:
    """The language model's, and those of both files under their file's name, without what DistributedDataParallel puts in front."""
    tensors, aliases = read_stored(folder, problems)
    steps = {}
    for part in SIDECARS:
        pattern = re.compile(re.escape(part) + r"--(.+)_checkpoint\.pt")
        found = {name: match[1] for name in sorted(os.listdir(folder)) for match in [pattern.fullmatch(name)] if match}
        if len(found) != 1:
            hint = "the reference loads the only one" if found else "download it beside config.json"
            problems.add("{}--STEP_checkpoint.pt".format(part), "one such file", ", ".join(found) or "none", hint)
            continue
        ((name, steps[part]),) = found.items()
        for stored, entry in read_torch(os.path.join(folder, name), "").items():
            own = "{}.{}".format(part, stored[len("module.") :] if stored.startswith("module.") else stored)
            tensors[own] = entry._replace(name=own)
    if len(set(steps.values())) > 1:
        (head, proprio), where = (steps[part] for part in SIDECARS), "{}--{}_checkpoint.pt".format
        problems.add(where(SIDECARS[1], proprio), "the step of " + where(SIDECARS[0], head), proprio, "give the files of one step")
    return tensors, aliases


LAYOUT = Layout(
    "BitVLA's authors",
    (
        stats("the entry of dataset_statistics.json to normalize with, where there are several"),
        views("names of the cameras, in the order of the prompt's view slots"),
        Option("--plain-images", "images do not go through a JPEG of quality 95, as they do in the authors' evaluation", default=False),
    ),
    model_types=("bitvla", "openvla"),
    read=_read_tensors,
)


def _read_robot(checkpoint: Checkpoint, s: Sizes, problems: Problems) -> None:
    def dim(name: str, axis: int) -> int:
        entry = checkpoint.tensors.get(name)
        if entry is None or len(entry.shape) != 2:
            problems.add("tensor " + name, "a matrix", "none" if entry is None else str(entry.shape))
            return 0
        return entry.shape[axis]

    s.d_state, s.d_action = dim(PROPRIO + "fc1.weight", 1), dim(HEAD + "fc2.weight", 0)
    s.horizon = HORIZONS.get((s.d_state, s.d_action), 0)
    if s.d_state and s.d_action and not s.horizon:
        problems.unsupported(
            "action_head, proprio_projector",
            "8 numbers of state and 7 of an action, which are LIBERO's",
            "{} and {}".format(s.d_state, s.d_action),
            "chunks and grippers of other robots are constants of the reference that are not read yet",
        )


def _statistics(checkpoint: Checkpoint, name: str, s: Sizes, problems: Problems) -> Tuple[Dict[str, np.ndarray], List[bool]]:
    """In float64, as the reference reads them, and which columns of an action are normalized."""
    everything = read_json(checkpoint.path(STATISTICS))
    if name not in everything and (name or len(everything) != 1):
        hint = "--stats NAME, the data set that the policy was tuned on"
        raise refuse(STATISTICS, "one of " + ", ".join(everything), name or "several", hint)
    name = name or next(iter(everything))
    where = "{}: {}".format(STATISTICS, name)
    stated = member(everything, name, dict, STATISTICS)
    tensors: Dict[str, np.ndarray] = {}
    for feature, key, width in ((recipe.STATE, "proprio", s.d_state), (recipe.ACTION, "action", s.d_action)):
        group = member(stated, key, dict, where)
        for quantile in ("q01", "q99"):
            values = group.get(quantile)
            sound = isinstance(values, list) and all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in values)
            numbers = np.asarray(values if sound else [], np.float64)
            if numbers.shape != (width,) or not np.isfinite(numbers).all():
                problems.add("{}.{}.{}".format(where, key, quantile), "{} finite numbers".format(width), str(values)[:80])
            tensors["stats.{}.{}".format(feature, quantile)] = numbers
    mask = member(stated, "action", dict, where).get("mask")
    if not isinstance(mask, list) or len(mask) != s.d_action or not all(isinstance(on, bool) for on in mask):
        hint = "without it the reference would stretch the gripper as well"
        problems.add(where + ".action.mask", "true or false for {} numbers".format(s.d_action), str(mask)[:80], hint)
        mask = [True] * s.d_action
    elif mask[GRIPPER]:
        problems.unsupported(where + ".action.mask", "false for the gripper, number {}".format(GRIPPER), "true")
    if member(stated, "proprio", dict, where).get("mask", [True] * s.d_state) != [True] * s.d_state:
        problems.unsupported(where + ".proprio.mask", "true for all numbers", str(stated["proprio"]["mask"])[:80])
    return tensors, mask


def _check_images(checkpoint: Checkpoint, s: Sizes, problems: Problems) -> None:
    side, patch = s.vision.image_size, s.vision.patch_size
    images = Section(IMAGES, read_json(checkpoint.path(IMAGES)), {}, problems)
    images.check_fixed(IMAGES_FIXED)
    images.refuse_unknown({*IMAGES_FIXED, *IMAGES_IGNORED})
    if images.get("size") != {"height": side, "width": side}:
        images.bad("size", "height and width {}, those of the tower".format(side), unsupported=True)
    if not os.path.exists(checkpoint.path(PROCESSOR)):
        return
    processor = Section(PROCESSOR, read_json(checkpoint.path(PROCESSOR)), {"patch_size": patch, "image_token": IMAGE}, problems)
    processor.refuse_unknown({*PROCESSOR_IGNORED, "patch_size", "image_token"})
    processor.fixed("patch_size", patch)
    processor.fixed("image_token", IMAGE)


def _system_sentence(checkpoint: Checkpoint, problems: Problems) -> str:
    """What the chat template says before the user does."""
    where = "chat_template.jinja"
    if os.path.exists(checkpoint.path(where)):
        stated = read_text(checkpoint.path(where))
    else:
        where = "tokenizer_config.json: chat_template"
        stated = read_json(checkpoint.path("tokenizer_config.json")).get("chat_template")
    text = stated if isinstance(stated, str) else ""
    system = text[: -len(TEMPLATE)]
    if not text.endswith(TEMPLATE) or set(system) & set("{}") or not system.isascii():
        problems.unsupported(where, "a sentence and then " + TEMPLATE, repr(stated)[:120])
        return ""
    return system


def _prompt(checkpoint: Checkpoint, tokenizer: TokenizerPlan, s: Sizes, problems: Problems) -> Tuple[List[dict], List[Key]]:
    before, n_view = _system_sentence(checkpoint, problems) + "User: ", s.vision.n_patch
    own = (BOS, STOP, END, IMAGE, STATE)
    ids = dict(zip(own, special_ids(tokenizer.keys, own, "the tokenizer is not BitVLA's", problems)))
    first, question = re.split(re.escape(END), before), QUESTION.partition("{")[0]
    check_undivided(tokenizer.keys, own, [*first, question, "Assistant: "], problems)
    prefix = next((key.value for key in tokenizer.keys if key.name == "tokenizer.prefix_ids"), [])
    if prefix != [ids[BOS]]:
        problems.unsupported("tokenizer.json: post_processor", "one {} in front".format(BOS), str(prefix))
    encoder = Encoder(tokenizer.keys)
    s.stop_token = max(ids[STOP], 0)
    start = len(prefix) + sum(len(encoder.ids(part)) for part in first) + len(first) - 1
    starts = [start + i * n_view for i in range(s.max_views)]
    end = starts[-1] + n_view
    n_answer = s.d_action * s.horizon + 1
    if end + 32 + n_answer > s.n_context:
        expected = "room for {} views of {} tokens and {} of actions".format(s.max_views, n_view, n_answer)
        problems.add("config.json: text_config: max_position_embeddings", expected, str(s.n_context))
    limit = min(end + N_INSTRUCTION, s.n_context - n_answer)
    text = [
        {"op": "lower"},
        {"op": "template", "text": STATE + QUESTION},
        {"op": "views", "count": s.max_views, "open": "", "token": IMAGE, "repeat": n_view, "close": ""},
        {"op": "template", "text": before + "{instruction}" + END + "Assistant: "},
        {"op": "tokenize", "max_tokens": limit, "truncate": "right"},
    ]
    return text, [Key("policy.view_starts", "u32[]", starts), Key("observation.max_text_tokens", "u32", limit)]


def _features(views: List[str], options: Options, notes: List[str], s: Sizes, problems: Problems) -> List[Key]:
    names = [view_name(view) for view in views]
    aliases = [view_name(alias) for alias in ALIASES] if tuple(views) == VIEWS else [""] * len(views)
    keys, dims = views_of(names, aliases, [0] * len(views), len(views)), {recipe.STATE: s.d_state, recipe.ACTION: s.d_action}
    return robot_keys(keys, dims, options.dataset_info, notes, problems)

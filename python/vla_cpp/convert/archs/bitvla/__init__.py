# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""BitVLA: a SigLIP tower and BitNet b1.58, both with ternary weights, that compute the slots of a whole chunk in one pass, and an MLP-ResNet.

A fine-tune is a folder: config.json, bfloat16 master weights, tokenizer and processor files, dataset_statistics.json, and one torch.save file
each for the action head and the proprio projector. A robot is a set of constants in the authors' code, chosen by the command line of a
training run; the widths of head and projector identify it.

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
from ...options import stats, views
from ...section import Fixed, Section
from ...tokenizer import TokenizerPlan, read_tokenizer
from .. import Options, Plan, oft
from .mapping import HEAD, PROPRIO, Sizes, dropped, network_keys, read_sizes, weights

PROCESSOR, IMAGES = "processor_config.json", "preprocessor_config.json"
HORIZONS = {(8, 7): 8}  # (width of the state, width of the action) -> rows of a chunk; this is LIBERO
BOS, STOP, END, IMAGE, STATE = "<|begin_of_text|>", "<|end_of_text|>", "<|eot_id|>", "<|image_pad|>", "<proprio_pad>"
QUESTION = "What action should the robot take to {instruction}?"
# The template of convert_ckpt.py after the system's sentence: one user message, and the start of the assistant's.
TEMPLATE = (
    "{% set loop_messages = messages %}{% for message in loop_messages %}{% set content = message['role'] | capitalize + ': '"
    "+ message['content'] | trim + '<|eot_id|>' %}{{ content }}{% endfor %}{% if add_generation_prompt %}{{ 'Assistant: ' }}{% endif %}"
)
N_INSTRUCTION = 512  # tokens; far above any instruction, since the reference truncates none
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
    views = list(options.views) or list(oft.VIEWS)
    s.max_views = len(views)
    _read_robot(checkpoint, s, problems)
    problems.raise_any()
    statistics, mask = _statistics(checkpoint, options.stats, s, problems)
    _check_images(checkpoint, s, problems)
    tokenizer = read_tokenizer(checkpoint.folder, s.lm.n_vocab, problems, checkpoint.notes)
    problems.raise_any()  # the prompt needs a valid tokenizer
    text, prompt_keys = _prompt(checkpoint, tokenizer, s, problems)
    kind = "openpi_quantiles"  # the formula is the same, with statistics in float64
    document = {
        "image": image_ops(s.vision.image_size, options.plain_images),
        "text": text,
        "state": oft.state_ops(kind, s.d_state),
        "action": oft.action_ops(kind, mask, True),
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
    half = [0.5] * 3
    return [*oft.image_ops(side, plain), {"op": "standardize", "mean": half, "std": half, "arithmetic": "float32_then_bfloat16"}]


def _read_tensors(folder: str, problems: Problems) -> Tensors:
    """The tensors of the language model, and of the two files beside it."""
    tensors = read_stored(folder, problems)
    oft.read_parts(folder, tensors, ("action_head", "proprio_projector"), (), problems)
    return tensors


LAYOUT = Layout(
    "BitVLA's authors",
    (
        stats("the entry of dataset_statistics.json to normalize with, where there are several"),
        views("names of the cameras, in the order of the prompt's view slots"),
        oft.PLAIN_IMAGES,
    ),
    model_types=("bitvla", "openvla"),
    read=_read_tensors,
)


def _read_robot(checkpoint: Checkpoint, s: Sizes, problems: Problems) -> None:
    s.d_state = oft.dim(checkpoint, PROPRIO + "fc1.weight", 1, problems)
    s.d_action = oft.dim(checkpoint, HEAD + "fc2.weight", 0, problems)
    s.horizon = HORIZONS.get((s.d_state, s.d_action), 0)
    if s.d_state and s.d_action and not s.horizon:
        problems.unsupported(
            "action_head, proprio_projector",
            "8 numbers of state and 7 of an action, which are LIBERO's",
            "{} and {}".format(s.d_state, s.d_action),
            "chunks and grippers of other robots are constants of the reference that are not read yet",
        )


def _statistics(checkpoint: Checkpoint, name: str, s: Sizes, problems: Problems) -> Tuple[Dict[str, np.ndarray], List[bool]]:
    """The statistics, in float64 as in the reference, and which columns of an action are normalized."""
    everything = read_json(checkpoint.path(oft.STATISTICS))
    if name not in everything and (name or len(everything) != 1):
        hint = "--stats NAME, the data set that the policy was tuned on"
        raise refuse(oft.STATISTICS, "one of " + ", ".join(everything), name or "several", hint)
    name = name or next(iter(everything))
    where = "{}: {}".format(oft.STATISTICS, name)
    stated = member(everything, name, dict, oft.STATISTICS)
    widths = {recipe.STATE: s.d_state, recipe.ACTION: s.d_action}
    tensors, mask = oft.ranges(stated, where, widths, ("q01", "q99"), problems)
    if "mask" not in member(stated, "action", dict, where):
        hint = "without it the reference would stretch the gripper as well"
        problems.add(where + ".action.mask", "true or false for {} numbers".format(s.d_action), "None", hint)
    elif mask[oft.GRIPPER] and stated["action"]["mask"] == mask:
        problems.unsupported(where + ".action.mask", "false for the gripper, number {}".format(oft.GRIPPER), "true")
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
    """The chat template's text before the user's message."""
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
    aliases = [view_name(alias) for alias in oft.ALIASES] if tuple(views) == oft.VIEWS else [""] * len(views)
    keys, dims = views_of(names, aliases, [0] * len(views), len(views)), {recipe.STATE: s.d_state, recipe.ACTION: s.d_action}
    return robot_keys(keys, dims, options.dataset_info, notes, problems)

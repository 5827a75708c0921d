# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""VLA-Adapter: OpenVLA's towers, a Qwen2.5 0.5B that reads action queries, and a head whose layers attend to those of Qwen.

A fine-tune is a folder: config.json, weights, tokenizer and processor files, dataset_statistics.json, and one torch.save file each for the
action head and the proprio projector, on the hub without a step in its name. A robot is a set of constants in the authors' code, chosen by a
word of the command line; the authors' two evaluations treat the gripper differently. No file states the robot.

Reference: OpenHelix-Team/VLA-Adapter (experiments/robot/openvla_utils.py, experiments/robot/libero/run_libero_eval.py,
vla-scripts/{vla_evaluation,evaluate_calvin,finetune}.py, prismatic/vla/constants.py).
"""

from __future__ import annotations

import os
from typing import Dict, List, NamedTuple, Tuple

from ... import recipe
from ...ascii_bpe import check_undivided, special_ids
from ...checkpoint import Checkpoint, Layout, Tensors, read_stored
from ...errors import Code, Problems, refuse
from ...features import robot_keys, view_name, views_of
from ...options import Option, stats, views
from ...tokenizer import TokenizerPlan, read_tokenizer
from .. import Options, Plan, oft, openvla
from .mapping import BACKBONES, dropped, network_keys, read_sizes, weights

START, END = "<|im_start|>", "<|im_end|>"
SYSTEM = "system\nYou are Qwen, created by Alibaba Cloud. You are a helpful assistant."
QUESTION, ANSWER = "What action should the robot take to ", "?"
MAX_TOKENS = 512  # tokens of a prompt; far above any instruction, since the reference truncates none


class Platform(NamedTuple):
    """A robot's constants and the treatment of its gripper in the authors' evaluation."""

    horizon: int
    d_state: int
    d_action: int
    views: Tuple[str, ...]
    aliases: Tuple[str, ...]


PLATFORMS: Dict[str, Platform] = {
    "libero": Platform(8, 8, 7, oft.VIEWS, oft.ALIASES),
    "calvin": Platform(8, 8, 7, ("rgb_static", "rgb_gripper"), ("", "")),
}
KIND = "openpi_quantiles"  # the formula of BOUNDS_Q99, with statistics in float64
# vla_evaluation.py subtracts the gripper from 1; evaluate_calvin.py maps this to [-1, 1], takes the sign, also of 0, and inverts it.
CALVIN: List[dict] = [{"op": "threshold", "columns": [oft.GRIPPER], "above": 0.5, "then": 1.0, "else": -1.0}]
PLATFORM = Option(
    "--platform",
    "whose constants and evaluation (their ROBOT_PLATFORM): length of a chunk, normalization, gripper, cameras; ALOHA and BRIDGE have constants, but"
    " no evaluation says what becomes of their grippers",
    choices=tuple(PLATFORMS),
)


def plan(checkpoint: Checkpoint, options: Options, problems: Problems) -> Plan:
    if options.platform not in PLATFORMS:
        hint = "no file of the checkpoint states its robot"
        raise refuse("--platform", " or ".join(PLATFORMS), options.platform or "none", hint, Code.USAGE)
    platform, s = PLATFORMS[options.platform], read_sizes(checkpoint, problems)
    cameras = tuple(options.views) or platform.views
    s.horizon = platform.horizon
    if (s.d_state, s.d_action) != platform[1:3]:
        expected = "{} numbers of state and {} of an action, which are those of --platform {}".format(*platform[1:3], options.platform)
        problems.unsupported("proprio_projector, action_head", expected, "{} and {}".format(s.d_state, s.d_action))
    stated, where = openvla.chosen_statistics(checkpoint, options.stats)
    widths = {recipe.STATE: s.d_state, recipe.ACTION: s.d_action}
    statistics, mask = oft.ranges(stated, where, widths, ("q01", "q99"), problems)
    pixels = openvla.read_pixels(checkpoint, s.dino.image_size, problems)
    tokenizer = read_tokenizer(checkpoint.folder, s.lm.n_vocab, problems, checkpoint.notes)
    problems.raise_any()  # the prompt needs a valid tokenizer
    text = _text_ops(tokenizer, problems)
    n, aliases = len(cameras), platform.aliases if cameras == platform.views else ("",) * len(cameras)
    views_keys = views_of([view_name(name) for name in cameras], [alias and view_name(alias) for alias in aliases], [0] * n, n)
    document = {
        "image": oft.image_ops(s.dino.image_size, options.plain_images),
        "text": text,
        "state": oft.state_ops(KIND, s.d_state),
        "action": oft.action_ops(KIND, mask, options.platform == "libero") + (CALVIN if options.platform == "calvin" else []),
    }
    keys = [
        *network_keys(s),
        *robot_keys(views_keys, widths, options.dataset_info, checkpoint.notes, problems, MAX_TOKENS),
        *tokenizer.keys,
        recipe.recipe_key(document),
    ]
    problems.raise_any()
    return Plan(keys, weights(s, pixels), dropped(s), statistics)


def _text_ops(tokenizer: TokenizerPlan, problems: Problems) -> List[dict]:
    special_ids(tokenizer.keys, (START, END), "the tokenizer is not Qwen2's", problems)
    check_undivided(tokenizer.keys, (START, END), [SYSTEM, "user", QUESTION, ANSWER, "assistant"], problems)
    said = "{0}{1}{2}\n{0}user\n{3}{{instruction}}{4}{2}\n{0}assistant\n".format(START, SYSTEM, END, QUESTION, ANSWER)
    return [{"op": "lower"}, {"op": "template", "text": said}, {"op": "tokenize", "max_tokens": MAX_TOKENS, "truncate": "right"}]


def _read_tensors(folder: str, problems: Problems) -> Tensors:
    """The tensors of the language model, and of the two files beside it."""
    modulated = sorted(name for name in os.listdir(folder) if name.startswith("vision_backbone--"))
    if modulated:
        problems.unsupported(modulated[0], "towers that no instruction modulates", "those of a policy trained with use_film")
    tensors = read_stored(folder, problems)
    oft.read_parts(folder, tensors, ("action_head", "proprio_projector"), (), problems)
    return tensors


LAYOUT = Layout(
    "VLA-Adapter's authors",
    (
        stats("the data set whose statistics un-normalize actions (their unnorm_key), where there are several"),
        views("names of the cameras, in the order in which the network sees them"),
        oft.PLAIN_IMAGES,
        PLATFORM,
    ),
    model_types=("openvla",),
    value=("llm_backbone_id", BACKBONES),
    read=_read_tensors,
)

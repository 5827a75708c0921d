# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Converts checkpoints of VLA-JEPA to keys and tensors of a bundle.

Reference: lerobot src/lerobot/policies/vla_jepa (configuration_vla_jepa.py, modeling_vla_jepa.py, qwen_interface.py, action_head.py,
processor_vla_jepa.py) and transformers models/qwen3_vl.
"""

from __future__ import annotations

from typing import List

import numpy as np

from ... import recipe
from ...checkpoint import PROCESSORS, Checkpoint
from ...errors import Problems
from ...features import robot_keys
from ...files import member
from ...lerobot import required_view_keys
from ...tokenizer import read_tokenizer
from .. import Options, Plan
from ..gr00t import qwen3_vl
from .config import FOLDER, PLACEHOLDERS, Sizes, read_sizes
from .mapping import dropped, hints, network_keys, weights

CLIP, SNAP, BINARIZE = "vla_jepa_clip_actions", "vla_jepa_pre_snap_gripper", "vla_jepa_binarize_gripper"
GRIPPER = {"gripper_dim": recipe.ANY, "threshold": recipe.ANY}
PREPARE = "vla_jepa_image_prep"  # in releases after 0.6.1: the resize that the policy itself did until then; frames always have three channels here
OWN_STEPS: recipe.Steps = {
    recipe.PRE: {PREPARE: {"resize_to": recipe.ANY, "expand_channels": (True,)}, **recipe.RELATIVE[recipe.PRE]},
    recipe.POST: {CLIP: {}, SNAP: GRIPPER, BINARIZE: GRIPPER, **recipe.RELATIVE[recipe.POST]},
}
# Defaults in processor_vla_jepa.py. LeRobot does not save these numbers with the steps, so loading restores the defaults.
GRIPPER_DIM, GRIPPER_THRESHOLD = 6, 0.5


def plan(checkpoint: Checkpoint, options: Options, problems: Problems) -> Plan:
    if checkpoint.processors is None:
        problems.add(" and ".join(PROCESSORS), "the pipelines that LeRobot saves with this policy", "none")
        problems.raise_any()
    s = read_sizes(checkpoint, options, problems)
    problems.raise_any()
    dims = {**({recipe.STATE: s.d_state} if s.d_state else {}), recipe.ACTION: s.d_action}
    processors = recipe.read_processors(checkpoint, dims, options.identity_stats, problems, OWN_STEPS, reads_text=False)
    _check_steps(checkpoint, processors, problems)
    own = [*s.action_tokens, s.embodied_token]
    tokenizer = read_tokenizer(s.folder, s.lm.n_vocab + len(own), problems, checkpoint.notes, own)
    problems.raise_any()
    # The reference enlarges the table of tokens if it has too few rows.
    s.lm.n_vocab = max(s.lm.n_vocab, len(tokenizer.tokens))
    prompt = qwen3_vl.read_prompt(tokenizer, s.folder, s, problems, FOLDER)
    prompt = prompt._replace(n_token=min(prompt.n_token + len(s.prompt.encode()), s.n_context))
    document = {
        "image": image_ops(s),
        "text": text_ops(s, prompt.n_token),
        "state": processors.state.op("normalize", recipe.STATE) if s.d_state else [],
        "action": action_ops(checkpoint, s, processors, problems),
    }
    views = required_view_keys(checkpoint, s.views, processors, problems)
    keys = [
        *network_keys(s),
        *prompt.keys(),
        *robot_keys(views, dims, options.dataset_info, checkpoint.notes, problems),
        *tokenizer.keys,
        recipe.recipe_key(document),
    ]
    problems.raise_any()
    return Plan(keys, weights(s), dropped(s), processors.statistics(), hints(s))


def _check_steps(checkpoint: Checkpoint, processors: recipe.Processors, problems: Problems) -> None:
    """Checks that config.json and the pipelines agree."""
    size, relative = checkpoint.config.get("resize_images_to"), bool(checkpoint.config.get("use_relative_actions"))
    for step in member(checkpoint.processors[0], "steps", list, recipe.PRE):
        stated = member(step, "config", dict, recipe.PRE).get("resize_to", size) if step.get("registry_name") == PREPARE else size
        if stated != size:
            problems.add("{}: {}: resize_to".format(recipe.PRE, PREPARE), "{} as config.json has it".format(size), str(stated)[:80])
    if processors.relative != relative:
        expected = "{} as the pipelines have it".format(processors.relative)
        problems.add("config.json: use_relative_actions", expected, str(relative))


def image_ops(s: Sizes) -> List[dict]:
    """The image ops, all on floats: the reference passes its float images to the backbone's processor without rescaling."""
    size = {"op": "resize_floats", "width": s.image_width, "height": s.image_height, "filter": "bicubic"}
    if s.area == (0, 0):
        sizes = [{**size, "from_width": s.frame[0], "from_height": s.frame[1]}]
    else:
        sizes = [{"op": "resize_floats", "width": s.area[0], "height": s.area[1], "filter": "area"}, size]
    return [*sizes, {"op": "standardize", "mean": [0.5] * 3, "std": [0.5] * 3, "arithmetic": "float32"}]


def text_ops(s: Sizes, n_token: int) -> List[dict]:
    """The text ops. An instruction that contains a special token of the prompt is refused: it would add rows to the head's input, or image
    positions. An instruction that is too long is refused too: truncation on the left would remove the views, and the reference never
    truncates."""
    views = {"open": qwen3_vl.OPEN, "token": qwen3_vl.IMAGE, "repeat": s.n_view_token, "close": qwen3_vl.CLOSE}
    return [
        *({"op": "refuse", "text": text} for text in (s.embodied_token, *PLACEHOLDERS)),
        {"op": "template", "text": s.prompt},
        {"op": "views", "count": s.max_views, **views},
        {"op": "template", "text": qwen3_vl.TEMPLATE.before + "{instruction}"},
        {"op": "tokenize", "max_tokens": n_token, "truncate": "left"},
    ]


def action_ops(checkpoint: Checkpoint, s: Sizes, processors: recipe.Processors, problems: Problems) -> List[dict]:
    """The action ops, in the order of the saved pipeline's steps."""
    ops: List[dict] = []
    for i, step in enumerate(member(checkpoint.processors[1], "steps", list, recipe.POST)):
        name = step["registry_name"]
        if name == "unnormalizer_processor":
            ops += processors.action.op("unnormalize", recipe.ACTION)
        elif name == "absolute_actions_processor" and processors.add_state:
            ops.append({"op": "add_state", "columns": list(processors.add_state)})
        elif name == CLIP:
            ops.append({"op": "clip", "low": -1.0, "high": 1.0})
        elif name in (SNAP, BINARIZE):
            ops += gripper_ops(name, "{}: steps[{}] {}".format(recipe.POST, i, name), step.get("config", {}), s, problems)
    return ops


def gripper_ops(name: str, where: str, config: dict, s: Sizes, problems: Problems) -> List[dict]:
    """The ops of a gripper step; empty for a chunk without the gripper's column. One of the reference's two steps compares float32 numbers with
    >=; the runtime compares with >, so the threshold is then the next smaller float32."""
    column, threshold = config.get("gripper_dim", GRIPPER_DIM), config.get("threshold", GRIPPER_THRESHOLD)
    if type(column) is not int or column < 0:
        problems.unsupported(where + ": gripper_dim", "a column from 0 on", repr(column))
        return []
    if not isinstance(threshold, (int, float)) or isinstance(threshold, bool) or not abs(threshold) < 1e6:
        problems.add(where + ": threshold", "a number", repr(threshold))
        return []
    if column >= s.d_action:
        return []
    above = np.float32(threshold)
    if name == SNAP:
        return [
            {"op": "threshold", "columns": [column], "above": float(np.nextafter(above, np.float32(-np.inf))), "then": 1.0, "else": 0.0}
        ]
    return [{"op": "threshold", "columns": [column], "above": float(above), "then": -1.0, "else": 1.0}]

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Converts checkpoints of SmolVLA to keys and tensors of a bundle.

Reference: lerobot src/lerobot/policies/smolvla (configuration_smolvla.py, smolvlm_with_expert.py, modeling_smolvla.py) and
transformers models/smolvlm. Shapes come from the configs alone; a tensor of another shape is refused, not adopted.
"""

from __future__ import annotations

from typing import Dict, List

from ... import recipe
from ...checkpoint import Checkpoint
from ...errors import Problems
from ...features import robot_keys
from ...lerobot import tokenizer_folder, view_keys
from ...tokenizer import read_tokenizer
from .. import Options, Plan
from .config import Sizes, read_sizes
from .mapping import dropped, hints, network_keys, weights

STEPS: recipe.Steps = {recipe.PRE: {"smolvla_new_line_processor": {}}}


def plan(checkpoint: Checkpoint, options: Options, problems: Problems) -> Plan:
    sizes = read_sizes(checkpoint, options, problems)
    problems.raise_any()
    dims = {recipe.STATE: sizes.state_dim, recipe.ACTION: sizes.action_dim}
    processors = recipe.read_processors(checkpoint, dims, options.identity_stats, problems, STEPS)
    folder = tokenizer_folder(checkpoint, options, processors) or sizes.backbone
    tokenizer = read_tokenizer(folder, sizes.lm.n_vocab, problems, checkpoint.notes)
    # One view suffices: the reference (prepare_images) drops or masks missing views, which is equivalent.
    views = view_keys(checkpoint, sizes.views, processors, problems)
    keys = [
        *network_keys(sizes),
        *robot_keys(views, dims, options.dataset_info, checkpoint.notes, problems, processors.max_tokens),
        *tokenizer.keys,
        recipe.recipe_key(recipe_document(sizes, processors, tokenizer.truncate)),
    ]
    problems.raise_any()
    return Plan(keys, weights(sizes), dropped(sizes), processors.statistics(), hints(sizes))


def recipe_document(s: Sizes, processors: recipe.Processors, truncate: str) -> Dict[str, List[dict]]:
    return {
        "image": [recipe.letterbox(*s.frame, "bottom_right"), {"op": "affine", "scale": 2.0, "shift": -1.0}],
        "text": recipe.text_ops(processors, truncate),
        "state": [*processors.state.op("normalize", recipe.STATE), {"op": "pad", "size": s.d_state}],
        "action": [{"op": "take", "size": s.action_dim}, *processors.action.op("unnormalize", recipe.ACTION)],
    }

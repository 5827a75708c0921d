# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Converts checkpoints of TurboVLA to keys and tensors of a bundle.

Reference: lerobot_policy_turbovla (configuration_turbovla.py, modeling_turbovla.py, vl_interaction.py, action_decoder.py,
processor_turbovla.py) and transformers models/dinov3_vit and models/bert.
"""

from __future__ import annotations

from typing import Dict, List

from ... import recipe
from ...checkpoint import Checkpoint
from ...errors import Problems
from ...features import robot_keys
from ...images import IMAGENET
from ...lerobot import required_view_keys
from ...tokenizer import read_tokenizer
from .. import Options, Plan
from .config import Sizes, read_sizes
from .mapping import dropped, hints, network_keys, weights


def plan(checkpoint: Checkpoint, options: Options, problems: Problems) -> Plan:
    s = read_sizes(checkpoint, options, problems)
    problems.raise_any()
    dims = {**({recipe.STATE: s.d_state} if s.d_state else {}), recipe.ACTION: s.d_action}
    processors = recipe.read_processors(checkpoint, dims, options.identity_stats, problems, {}, reads_text=False)
    tokenizer = read_tokenizer(s.lm_folder, s.lm.n_vocab, problems, checkpoint.notes)
    problems.raise_any()
    views = required_view_keys(checkpoint, s.views, processors, problems)
    keys = [
        *network_keys(s),
        *robot_keys(views, dims, options.dataset_info, checkpoint.notes, problems, s.max_tokens),
        *tokenizer.keys,
        recipe.recipe_key(recipe_document(s, processors, tokenizer.truncate)),
    ]
    problems.raise_any()
    return Plan(keys, weights(s), dropped(s), processors.statistics(), hints(s))


def recipe_document(s: Sizes, processors: recipe.Processors, truncate: str) -> Dict[str, List[dict]]:
    side = s.vision.image_size
    return {
        "image": [
            {"op": "resize", "width": side, "height": side, "filter": "torch_bilinear"},
            {"op": "standardize", **IMAGENET, "arithmetic": "float32"},
        ],
        "text": [{"op": "tokenize", "max_tokens": s.max_tokens, "truncate": truncate}],
        "state": processors.state.op("normalize", recipe.STATE) if s.d_state else [],
        "action": processors.action.op("unnormalize", recipe.ACTION),
    }

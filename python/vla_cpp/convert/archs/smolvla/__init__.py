# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""SmolVLA: what its checkpoint states, as keys and tensors of a bundle.

Reference: lerobot src/lerobot/policies/smolvla (configuration_smolvla.py, smolvlm_with_expert.py, modeling_smolvla.py) and
transformers models/smolvlm. Shapes come from the configs alone; a tensor of another shape is refused, not adopted.
"""

from __future__ import annotations

import json
from typing import Dict, List

from ... import recipe
from ...bundle import Key
from ...checkpoint import Checkpoint
from ...errors import Problems
from ...features import feature_keys, states_of
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
    document = json.dumps(recipe_document(sizes, processors, tokenizer.truncate), ensure_ascii=False)
    keys = [
        *network_keys(sizes),
        *_feature_keys(checkpoint, options, sizes, processors, problems),
        *tokenizer.keys,
        Key("processor.recipe", "string", document),
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


def _feature_keys(checkpoint: Checkpoint, options: Options, s: Sizes, processors: recipe.Processors, problems: Problems) -> List[Key]:
    """One view is enough: the reference (prepare_images) drops every view that is missing, or masks it, which is the same."""
    dims = {recipe.STATE: s.state_dim, recipe.ACTION: s.action_dim}
    return [
        *view_keys(checkpoint, s.views, processors, problems),
        *states_of({recipe.STATE: s.state_dim}),
        Key("observation.max_text_tokens", "u32", processors.max_tokens),
        *feature_keys(options.dataset_info, dims, checkpoint.notes, problems),
    ]

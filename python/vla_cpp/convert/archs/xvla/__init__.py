# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Converts checkpoints of X-VLA to keys and tensors of a bundle.

A checkpoint has layers and prompts for many domains; a bundle has those that --embodiment names, or the preprocessor's domain.
Reference: lerobot src/lerobot/policies/xvla (configuration_xvla.py, modeling_xvla.py, soft_transformer.py, action_hub.py,
processor_xvla.py) and transformers models/florence2 and models/bart.
"""

from __future__ import annotations

import os
from typing import Dict, List, Sequence

from ... import recipe
from ...checkpoint import Checkpoint
from ...errors import Code, Problems, refuse
from ...features import robot_keys
from ...files import read_json
from ...images import IMAGENET
from ...lerobot import given_tokenizer, view_keys
from ...tokenizer import TokenizerPlan, read_tokenizer
from ...tokenizer_parts import CONFIG_FILE, content_of
from .. import Options, Plan
from .config import Sizes, read_domain, read_sizes
from .mapping import dropped, hints, network_keys, weights

TOKENIZER = "facebook/bart-large"
TO_FLOAT, NORMALIZE, DOMAIN = "xvla_image_to_float", "xvla_imagenet_normalize", "xvla_add_domain_id"
STEPS: recipe.Steps = {
    recipe.PRE: {
        # Frames enter in [0, 1] here. The reference does not divide a frame by 255 if no byte of it is above 1.
        TO_FLOAT: {"image_keys": (None,), "validate_range": (True, False)},
        NORMALIZE: {"image_keys": (None,)},
        DOMAIN: {"domain_id": recipe.ANY},
    }
}


def embodiments(checkpoint: Checkpoint) -> List[str]:
    """The tags of the domains, which are their numbers."""
    count = checkpoint.config.get("num_domains", 30)
    return [str(domain) for domain in range(count if isinstance(count, int) else 0)]


def plan(checkpoint: Checkpoint, options: Options, problems: Problems) -> Plan:
    if checkpoint.processors is None:
        hint = "the domain and what happens to pixels stand there; save the policy again"
        raise refuse(recipe.PRE, "the file beside model.safetensors", "none", hint, Code.UNSUPPORTED)
    steps = _steps(checkpoint.processors[0])
    s = read_sizes(checkpoint, options, problems)
    s.domain = read_domain(options, steps.get(DOMAIN, {}), s.n_domain, problems)
    problems.raise_any()
    dims = {**({recipe.STATE: s.state_dim} if s.state_dim else {}), recipe.ACTION: s.action_dim}
    processors = recipe.read_processors(checkpoint, dims, options.identity_stats, problems, STEPS)
    _check_order(list(steps), problems)
    folder = given_tokenizer(checkpoint, options, processors, TOKENIZER)
    tokenizer = read_tokenizer(folder, s.lm.n_vocab, problems, checkpoint.notes)
    if steps.get("tokenizer_processor", {}).get("padding", "max_length") == "max_length":
        s.n_token, s.pad_token = processors.max_tokens, _pad_token(folder, tokenizer, problems)
    problems.raise_any()
    views = view_keys(checkpoint, s.views, processors, problems)
    keys = [
        *network_keys(s),
        *robot_keys(views, {**({recipe.STATE: s.unread_dim} if s.unread_dim else {}), **dims}, options.dataset_info, checkpoint.notes, problems, processors.max_tokens),
        *tokenizer.keys,
        recipe.recipe_key(recipe_document(s, processors, tokenizer.truncate, NORMALIZE in steps)),
    ]
    problems.raise_any()
    return Plan(keys, weights(s), dropped(s), processors.statistics(), hints(s))


def _steps(preprocessor: dict) -> Dict[str, dict]:
    """Settings of the steps by name, in order. recipe.read_processors reports invalid ones."""
    steps = preprocessor.get("steps")
    found = [step for step in steps if isinstance(step, dict)] if isinstance(steps, list) else []
    configs = {step.get("registry_name"): step.get("config", {}) for step in found}
    return {str(name): config if isinstance(config, dict) else {} for name, config in configs.items()}


def _check_order(steps: Sequence[str], problems: Problems) -> None:
    if TO_FLOAT in steps and NORMALIZE in steps and steps.index(TO_FLOAT) > steps.index(NORMALIZE):
        problems.unsupported(recipe.PRE, TO_FLOAT + " in front of " + NORMALIZE, "the opposite order", "the reference refuses it too")


def recipe_document(s: Sizes, processors: recipe.Processors, truncate: str, is_normalized: bool) -> Dict[str, List[dict]]:
    """The recipe. The reference resizes normalized pixels and pads with zeros, which in [0, 1] are the mean."""
    width, height = s.frame
    size = {"width": width, "height": height}
    fit = [{"op": "camera_size", **size}, {"op": "size", **size}]
    if s.resizes:
        box = recipe.letterbox(width, height, "bottom_right")
        fit = [{**box, "fill": IMAGENET["mean"]} if is_normalized else box]
    grippers = [{"op": "sigmoid", "columns": s.grippers}] if s.grippers else []
    take = [{"op": "take", "size": s.action_dim}] if s.action_dim < s.d_action else []
    return {
        "image": fit + ([{"op": "standardize", **IMAGENET, "arithmetic": "float32"}] if is_normalized else []),
        "text": recipe.text_ops(processors, truncate),
        "state": _state(s, processors),
        "action": [*grippers, *take, *processors.action.op("unnormalize", recipe.ACTION)],
    }


def _state(s: Sizes, processors: recipe.Processors) -> List[dict]:
    if s.state_dim:
        return [*processors.state.op("normalize", recipe.STATE), {"op": "pad", "size": s.d_state}]
    return [{"op": "drop"}] if s.unread_dim else []


def _pad_token(folder: str, tokenizer: TokenizerPlan, problems: Problems) -> int:
    """The id of the pad token. The reference does not mask padding, so the id affects the network."""
    path = os.path.join(folder, CONFIG_FILE)
    stated = content_of((read_json(path) if os.path.exists(path) else {}).get("pad_token", "<pad>"))
    if stated in tokenizer.tokens:
        return tokenizer.tokens.index(stated)
    problems.add(CONFIG_FILE + ": pad_token", "a token, since text is padded", repr(stated))
    return 0

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""TurboVLA in its authors' layout for LIBERO: a torch.save file with weights and model_config, and a file of statistics. (`turbovla` is a
port by other people, with a different network.)

Reference: H-EmbodVis/TurboVLA turbovla/models, turbovla/text/bert.py, turbovla/evaluation (policy.py, suite_policy.py),
turbovla/training/trainer.py (train_model); transformers models/dinov3_vit and models/bert.
"""

from __future__ import annotations

from typing import Dict, List

from ... import recipe
from ...bundle import Key
from ...checkpoint import Checkpoint
from ...errors import Problems
from ...features import robot_keys, views_of
from ...tokenizer import TokenizerPlan, read_tokenizer
from .. import Options, Plan
from .config import LAYOUT as LAYOUT
from .config import Sizes, read_normalization, read_pixels, read_sizes
from .mapping import dropped, hints, network_keys, weights

# Literals of turbovla/evaluation for the state and action of LIBERO's robot.
D_STATE, D_ACTION, GRIPPER = 8, 7, 6
EPS_STATE, EPS_ACTION = 1e-6, 1e-8
CLOSED_AT = -1.401298464324817e-45  # the largest float32 below zero, so that exactly zero does not open the gripper
ENDS = ("[CLS]", "[SEP]", ".", "?")  # tokens that end a sentence


def plan(checkpoint: Checkpoint, options: Options, problems: Problems) -> Plan:
    s = read_sizes(checkpoint, options, problems)
    for what, found, wanted in (("state_dim", s.d_state, D_STATE), ("action_dim", s.d_action, D_ACTION)):
        if found != wanted:
            hint = "how the authors' evaluation normalizes another robot's numbers is not read yet"
            problems.unsupported("model_config.action: " + what, "{}, as of LIBERO's robot".format(wanted), str(found), hint)
    problems.raise_any()
    statistics = read_normalization(checkpoint, options.stats, {"proprio": s.d_state, "action": s.d_action}, problems)
    pixels = read_pixels(checkpoint, problems)
    tokenizer = read_tokenizer(s.lm_folder, s.lm.n_vocab, problems, checkpoint.notes)
    problems.raise_any()
    dims = {recipe.STATE: s.d_state, recipe.ACTION: s.d_action}
    keys = [
        *network_keys(s),
        *_sentence_keys(tokenizer),
        *robot_keys(
            views_of(s.views, s.aliases, [0] * len(s.views), len(s.views)), dims, options.dataset_info, checkpoint.notes, problems, s.max_tokens
        ),
        *tokenizer.keys,
        recipe.recipe_key(recipe_document(s, pixels, tokenizer, problems)),
    ]
    problems.raise_any()
    return Plan(keys, weights(s), dropped(s), statistics, hints(s))


def _id_of(tokenizer: TokenizerPlan, token: str) -> int:
    """The id of a token, or of the unknown token if the vocabulary lacks it, as in convert_tokens_to_ids."""
    tokens = next(key.value for key in tokenizer.keys if key.name == "tokenizer.tokens")
    return tokens.index(token) if token in tokens else next(key.value for key in tokenizer.keys if key.name == "tokenizer.unknown_id")


def _sentence_keys(tokenizer: TokenizerPlan) -> List[Key]:
    ends = [_id_of(tokenizer, token) for token in ENDS]
    return [Key("policy.sentence_ends", "u32[]", ends), Key("policy.text_end", "u32", ends[1])]


def recipe_document(s: Sizes, pixels: Dict[str, object], tokenizer: TokenizerPlan, problems: Problems) -> Dict[str, List[dict]]:
    size = {"width": s.vision.image_size, "height": s.vision.image_size}
    if tokenizer.truncate != "right":
        problems.unsupported("tokenizer_config.json: truncation_side", "'right'", repr(tokenizer.truncate))
    tokenize: Dict[str, object] = {"op": "tokenize", "max_tokens": s.max_tokens, "truncate": tokenizer.truncate}
    limits: List[dict] = []
    if s.n_row:
        tokenize["pad_id"] = _id_of(tokenizer, "[PAD]")
        for size_of in sorted(set(s.limits.values()) - {s.n_row}):
            limits.append({"op": "limit", "max_tokens": size_of, "instructions": [text for text, n in s.limits.items() if n == size_of]})
    arm = [column for column in range(s.d_action) if column != GRIPPER]
    return {
        "image": [{"op": "camera_size", **size}, {"op": "size", **size}, {"op": "standardize", **pixels, "arithmetic": "float32"}],
        "text": [*limits, tokenize],
        "state": [{"op": "normalize", "kind": "mean_std", "stats": "stats." + recipe.STATE, "eps": EPS_STATE}],
        "action": [
            {"op": "unnormalize", "kind": "min_max", "stats": "stats." + recipe.ACTION, "eps": EPS_ACTION, "columns": arm},
            {"op": "threshold", "columns": [GRIPPER], "above": CLOSED_AT, "then": 1.0, "else": -1.0},
        ],
    }

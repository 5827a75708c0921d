# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Evo-1: InternVL3 as the prefix, a flow-matching head that reads the whole prompt by cross-attention.

Two layouts, the authors' and LeRobot's, with a module each; what they share stands here.
"""

from __future__ import annotations

import json
import os
from typing import List

from ..bundle import Key, keys_by_type
from ..checkpoint import EVO1, Checkpoint
from ..errors import Problems
from ..files import read_json
from ..tokenizer import TokenizerPlan, read_tokenizer
from ..tokenizer_byte_level import with_defaults
from . import Options, Plan
from ._evo1_authors import read_authors
from ._evo1_lerobot import read_lerobot
from ._evo1_names import weights
from ._evo1_prompt import Prompt, read_prompt, view_op
from ._evo1_sizes import Sizes
from ._evo1_source import Source


def plan(checkpoint: Checkpoint, options: Options, problems: Problems) -> Plan:
    read = read_authors if checkpoint.layout == EVO1 else read_lerobot
    source = read(checkpoint, options, problems)
    problems.raise_any()
    sizes = source.sizes
    tokenizer = read_tokenizer(source.tokenizer, sizes.n_vocab, problems, checkpoint.notes)
    problems.raise_any()  # a prompt takes a sound tokenizer
    prompt = _prompt(source, tokenizer, problems)
    document = {
        "image": source.image,
        "text": [
            {"op": "strip"},
            view_op(sizes.n_slot, sizes.n_view_token),
            {"op": "tokenize", "max_tokens": sizes.n_token, "truncate": tokenizer.truncate},
        ],
        "state": source.state,
        "action": source.action,
    }
    keys = [
        *_network_keys(sizes),
        Key("policy.pad_token", "u32", prompt.pad_token),
        Key("policy.view_starts", "u32[]", prompt.view_starts),
        *source.features,
        Key("observation.max_text_tokens", "u32", sizes.n_token),
        *tokenizer.keys,
        Key("processor.recipe", "string", json.dumps(document, ensure_ascii=False)),
    ]
    problems.raise_any()
    lm = source.names.lm + "layers."
    hints = {lm: "the policy keeps {} language layers, 0 to {}".format(sizes.n_layer, sizes.n_layer - 1)}
    return Plan(keys, weights(sizes, source.names), [], source.statistics, hints)


def _prompt(source: Source, tokenizer: TokenizerPlan, problems: Problems) -> Prompt:
    """The slots in the prompt, after checking that the tokenizer cuts, and where there are pads fills, behind them. LeRobot fills up
    to the longest prompt of a batch, which for one is none."""
    s, where = source.sizes, "tokenizer_config.json"
    config = with_defaults(read_json(os.path.join(source.tokenizer, where)))
    sides = {"truncation_side": tokenizer.truncate}
    if s.dead_rows != "unseen":
        sides["padding_side"] = config.get("padding_side", "right")
    for key, found in sides.items():
        if found != "right":
            problems.unsupported("{}: {}".format(where, key), "'right'", repr(found), "the views stand in front")
    pad = config.get("pad_token")
    pad = pad.get("content") if isinstance(pad, dict) else pad
    prompt = read_prompt(tokenizer, str(pad), s.n_slot, s.n_view_token, problems)
    if source.image_token not in (None, prompt.image_token):
        problems.add("backbone config.json: image_token_id", "{}, the tokenizer's".format(prompt.image_token), str(source.image_token))
    if prompt.view_starts[-1] + s.n_view_token > s.n_token:
        expected = "room for {} views of {} tokens".format(s.n_slot, s.n_view_token)
        problems.add("prompt", expected, "{} tokens".format(s.n_token), "the reference cannot cut into the views either")
    return prompt


def _network_keys(s: Sizes) -> List[Key]:
    u32 = {
        "policy.d_state": s.d_state,
        "policy.d_action": s.d_action,
        "policy.horizon": s.horizon,
        "policy.d_robot": s.d_robot,
        "policy.n_slot": s.n_slot,
        "policy.n_token": s.n_token,
        "vision.d_model": s.d_vision,
        "vision.n_layer": s.n_vision_layer,
        "vision.n_head": s.n_vision_head,
        "vision.d_ff": s.d_vision_ff,
        "vision.image_size": s.image_size,
        "vision.patch_size": s.patch_size,
        "connector.factor": 2,
        "lm.d_model": s.d_model,
        "lm.n_layer": s.n_layer,
        "lm.n_head": s.n_head,
        "lm.n_head_kv": s.n_head_kv,
        "lm.d_head": s.d_head,
        "lm.d_ff": s.d_ff,
        "lm.n_vocab": s.n_vocab,
        "head.n_layer": s.n_head_layer,
        "head.n_head": s.n_head_head,
        "head.d_ff": 4 * s.d_model,
        "head.d_hidden": s.d_hidden,
        "head.d_state_hidden": s.d_state_hidden,
        "solver.steps": s.n_step,
    }
    f32 = {
        "vision.norm_eps": s.vision_eps,
        "connector.norm_eps": 1e-5,  # torch's default, which the reference leaves as it is
        "lm.norm_eps": s.lm_eps,
        "lm.rope_base": s.rope_base,
        "head.norm_eps": 1e-5,
    }
    f64 = {"policy.time_scale": s.time_scale, "solver.t_start": 0.0, "solver.t_end": 1.0}
    text = {
        "policy.dead_rows": s.dead_rows,
        "policy.absent_views": s.absent_views,
        "solver.kind": "euler",
        "solver.noise": "uniform",
    }
    return keys_by_type({"u32": u32, "f32": f32, "f64": f64, "string": text})


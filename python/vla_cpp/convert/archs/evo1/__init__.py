# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Evo-1: InternVL3 as the prefix, and a flow-matching head that reads the whole prompt by cross-attention.

layouts.py reads the authors' and LeRobot's layout; mapping.py has keys and tensors.
"""

from __future__ import annotations

import json
import os
from typing import List, NamedTuple

from ...ascii_bpe import Encoder, check_undivided, special_ids
from ...bundle import Key
from ...checkpoint import LEROBOT, Checkpoint
from ...errors import Problems
from ...files import read_json
from ...recipe import recipe_key
from ...tokenizer import TokenizerPlan, read_tokenizer
from ...tokenizer_byte_level import with_defaults
from .. import Options, Plan
from .layouts import LAYOUT as LAYOUT
from .layouts import Source, read_authors, read_lerobot
from .mapping import network_keys, weights


def plan(checkpoint: Checkpoint, options: Options, problems: Problems) -> Plan:
    read = read_lerobot if checkpoint.layout == LEROBOT else read_authors
    source = read(checkpoint, options, problems)
    problems.raise_any()
    sizes = source.sizes
    tokenizer = read_tokenizer(source.tokenizer, sizes.lm.n_vocab, problems, checkpoint.notes)
    problems.raise_any()  # the prompt needs a valid tokenizer
    prompt = _prompt(source, tokenizer, problems)
    document = {
        "image": source.image,
        "text": [
            {"op": "strip"},
            view_op(sizes.max_views, sizes.n_view_token),
            {"op": "tokenize", "max_tokens": sizes.n_token, "truncate": tokenizer.truncate},
        ],
        "state": source.state,
        "action": source.action,
    }
    keys = [
        *network_keys(sizes),
        Key("policy.pad_token", "u32", prompt.pad_token),
        Key("policy.view_starts", "u32[]", prompt.view_starts),
        *source.features,
        Key("observation.max_text_tokens", "u32", sizes.n_token),
        *tokenizer.keys,
        recipe_key(document),
    ]
    problems.raise_any()
    lm = source.names.lm + "layers."
    hints = {lm: "the policy keeps {} language layers, 0 to {}".format(sizes.lm.n_layer, sizes.lm.n_layer - 1)}
    return Plan(keys, weights(sizes, source.names), [], source.statistics, hints)


def _prompt(source: Source, tokenizer: TokenizerPlan, problems: Problems) -> Prompt:
    """The positions of the views in the prompt. Checks that the tokenizer truncates on the right, after the views, and also pads there if the
    network sees pads. LeRobot pads to the longest prompt of a batch, so a single prompt has no pads."""
    s, where = source.sizes, "tokenizer_config.json"
    config = with_defaults(read_json(os.path.join(source.tokenizer, where)))
    sides = {"truncation_side": tokenizer.truncate}
    if s.masked_rows != "unseen":
        sides["padding_side"] = config.get("padding_side", "right")
    for key, found in sides.items():
        if found != "right":
            problems.unsupported("{}: {}".format(where, key), "'right'", repr(found), "the views stand in front")
    pad = config.get("pad_token")
    pad = pad.get("content") if isinstance(pad, dict) else pad
    prompt = read_prompt(tokenizer, str(pad), s.max_views, s.n_view_token, problems)
    if source.image_token not in (None, prompt.image_token):
        problems.add("backbone config.json: image_token_id", "{}, the tokenizer's".format(prompt.image_token), str(source.image_token))
    if prompt.view_starts[-1] + s.n_view_token > s.n_token:
        expected = "room for {} views of {} tokens".format(s.max_views, s.n_view_token)
        problems.add("prompt", expected, "{} tokens".format(s.n_token), "the reference cannot cut into the views either")
    return prompt


# --- the positions of image tokens at the beginning of a prompt, independent of the instruction -----------------------------------------

IMAGE, OPEN, CLOSE = "<IMG_CONTEXT>", "<img>", "</img>"
OP = {"op": "views", "open": "Image-{i}: " + OPEN, "token": IMAGE, "close": CLOSE + "\n"}
PAD_HINT = "the prompt is filled with it: load the tokenizer with transformers and save it again"


class Prompt(NamedTuple):
    view_starts: List[int]  # index of the first image token of every slot
    pad_token: int
    image_token: int


def view_op(max_views: int, n_token: int) -> dict:
    """The recipe's op for the views. `n_token`: image tokens per view."""
    return {"op": "views", "count": max_views, **{k: OP[k] for k in ("open", "token")}, "repeat": n_token, "close": OP["close"]}


def read_prompt(tokenizer: TokenizerPlan, pad_token: str, max_views: int, n_token: int, problems: Problems) -> Prompt:
    keys = tokenizer.keys
    image = special_ids(keys, (IMAGE, OPEN, CLOSE), "--backbone needs the folder of the InternVL3 backbone", problems)[0]
    added = next(key.value for key in keys if key.name == "tokenizer.added")
    pad = next((token["id"] for token in json.loads(added) if token["content"] == pad_token), -1)
    if pad < 0:
        problems.add("tokenizer_config.json: pad_token", "one of the added tokens", repr(pad_token), PAD_HINT)
    texts = [("\n" if i else "") + OP["open"].replace("{i}", str(i + 1))[: -len(OPEN)] for i in range(max_views)]
    check_undivided(keys, (IMAGE, OPEN, CLOSE), (*texts, IMAGE + OPEN + CLOSE), problems)
    encoder = Encoder(keys)
    starts: List[int] = []
    position = 0
    for text in texts:
        position += len(encoder.ids(text)) + 1  # <img>
        starts.append(position)
        position += n_token + 1  # </img>
    return Prompt(starts, max(pad, 0), image)

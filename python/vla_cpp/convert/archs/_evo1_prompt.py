# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The front of an Evo-1 prompt, which no instruction changes: where its image tokens stand."""

from __future__ import annotations

import json
from typing import List, NamedTuple

from ..errors import Problems
from ..tokenizer import TokenizerPlan
from ._ascii_bpe import Encoder, check_undivided, special_ids

IMAGE, OPEN, CLOSE = "<IMG_CONTEXT>", "<img>", "</img>"
OP = {"op": "views", "open": "Image-{i}: " + OPEN, "token": IMAGE, "close": CLOSE + "\n"}
PAD_HINT = "the prompt is filled with it: load the tokenizer with transformers and save it again"


class Prompt(NamedTuple):
    view_starts: List[int]  # index of the first image token of every slot
    pad_token: int
    image_token: int


def view_op(n_slot: int, n_token: int) -> dict:
    """`n_token`: image tokens of a view."""
    return {"op": "views", "count": n_slot, **{k: OP[k] for k in ("open", "token")}, "repeat": n_token, "close": OP["close"]}


def read_prompt(tokenizer: TokenizerPlan, pad_token: str, n_slot: int, n_token: int, problems: Problems) -> Prompt:
    keys = tokenizer.keys
    image = special_ids(keys, (IMAGE, OPEN, CLOSE), "--backbone needs the folder of the InternVL3 backbone", problems)[0]
    added = next(key.value for key in keys if key.name == "tokenizer.added")
    pad = next((token["id"] for token in json.loads(added) if token["content"] == pad_token), -1)
    if pad < 0:
        problems.add("tokenizer_config.json: pad_token", "one of the added tokens", repr(pad_token), PAD_HINT)
    texts = [("\n" if i else "") + OP["open"].replace("{i}", str(i + 1))[: -len(OPEN)] for i in range(n_slot)]
    check_undivided(keys, (IMAGE, OPEN, CLOSE), (*texts, IMAGE + OPEN + CLOSE), problems)
    encoder = Encoder(keys)
    starts: List[int] = []
    position = 0
    for text in texts:
        position += len(encoder.ids(text)) + 1  # <img>
        starts.append(position)
        position += n_token + 1  # </img>
    return Prompt(starts, max(pad, 0), image)

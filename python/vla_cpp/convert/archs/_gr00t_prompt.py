# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The prompt of GR00T N1.7: one turn of Qwen3-VL's chat template, without a system turn, the pictures before the instruction."""

from __future__ import annotations

import os
from typing import List, NamedTuple

from ..errors import Problems
from ..files import read_json
from ..tokenizer import TokenizerPlan
from ._ascii_bpe import Encoder, check_undivided, special_ids
from ._gr00t_sizes import WHERE, Sizes

START, END, OPEN, CLOSE, IMAGE = "<|im_start|>", "<|im_end|>", "<|vision_start|>", "<|vision_end|>", "<|image_pad|>"
ROLE = "user\n"
HINT = "--backbone needs the folder of nvidia/Cosmos-Reason2-2B"
# The reference cuts no instruction. The bundle states a longest prompt, far above any instruction.
N_INSTRUCTION = 512


class Prompt(NamedTuple):
    view_starts: List[int]  # index of the first image token of every view
    n_token: int  # the longest prompt


def text_ops(formalize: bool, prompt: Prompt, s: Sizes) -> List[dict]:
    clean = [{"op": "lower"}, {"op": "drop_punctuation"}] if formalize else []
    return [
        *clean,
        {"op": "views", "count": s.n_slot, "open": OPEN, "token": IMAGE, "repeat": s.n_view_token, "close": CLOSE},
        {"op": "template", "text": START + ROLE + "{instruction}" + END + "\n"},
        {"op": "tokenize", "max_tokens": prompt.n_token, "truncate": "right"},
    ]


def read_prompt(tokenizer: TokenizerPlan, folder: str, s: Sizes, problems: Problems) -> Prompt:
    own = (START, END, OPEN, CLOSE, IMAGE)
    ids = special_ids(tokenizer.keys, own, HINT, problems)
    check_undivided(tokenizer.keys, own, (ROLE,), problems)
    _check_backbone(folder, dict(zip(own, ids)), problems)
    _check_template(folder, problems)
    first = 1 + len(Encoder(tokenizer.keys).ids(ROLE)) + 1
    step = s.n_view_token + 2
    end = first + s.n_slot * step
    if end + 2 > s.n_context:
        expected = "room for {} views of {} tokens".format(s.n_slot, s.n_view_token)
        problems.add(WHERE + ": text_config: max_position_embeddings", expected, "{} tokens".format(s.n_context))
    return Prompt([first + i * step for i in range(s.n_slot)], min(end + N_INSTRUCTION, s.n_context))


def _check_backbone(folder: str, ids: dict, problems: Problems) -> None:
    """The network finds image tokens by the config's number, the prompt makes them by the tokenizer's."""
    config = read_json(os.path.join(folder, "config.json"))
    for key, default, text in (("image_token_id", 151655, IMAGE), ("vision_start_token_id", 151652, OPEN)):
        if config.get(key, default) != ids[text]:
            problems.add("{}: {}".format(WHERE, key), "{}, the tokenizer's {}".format(ids[text], text), repr(config.get(key, default)))


def _check_template(folder: str, problems: Problems) -> None:
    """The template is a program of its own; what is looked for here is what would make another prompt of one user's turn."""
    name, text = "chat_template.jinja", None
    if os.path.exists(os.path.join(folder, name)):
        with open(os.path.join(folder, name), encoding="utf-8", errors="replace") as file:
            text = file.read()
    for name in ("chat_template.json", "tokenizer_config.json"):
        if text is None and os.path.exists(os.path.join(folder, name)):
            text = read_json(os.path.join(folder, name)).get("chat_template")
    if not isinstance(text, str):
        return
    if OPEN + IMAGE + CLOSE not in text or "You are a helpful assistant" in text:
        problems.unsupported(name + ": chat_template", "Qwen3-VL's, which puts no words of its own before a user's", repr(text[:60]))

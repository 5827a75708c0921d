# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The front of an Evo-1 prompt, which no instruction changes: where its image tokens stand.

The text between the image tokens is ASCII, so that Qwen2's expression can be written with the classes that Python's `re` has.
"""

from __future__ import annotations

import json
import re
from typing import Dict, List, NamedTuple, Tuple

from ..errors import Problems
from ..tokenizer import TokenizerPlan
from ..tokenizer_byte_level import byte_symbols

IMAGE, OPEN, CLOSE = "<IMG_CONTEXT>", "<img>", "</img>"
OP = {"op": "views", "open": "Image-{i}: " + OPEN, "token": IMAGE, "close": CLOSE + "\n"}
WORDS = re.compile(
    r"'(?:[sS]|[tT]|[rR][eE]|[vV][eE]|[mM]|[lL][lL]|[dD])|[^\r\nA-Za-z0-9]?[A-Za-z]+|[0-9]"
    r"| ?[^\sA-Za-z0-9]+[\r\n]*|\s*[\r\n]+|\s+(?!\S)|\s+"
)
PAD_HINT = "the prompt is filled with it: load the tokenizer with transformers and save it again"


class Prompt(NamedTuple):
    view_starts: List[int]  # index of the first image token of every slot
    pad_token: int
    image_token: int


def view_op(n_slot: int, n_token: int) -> dict:
    """`n_token`: image tokens of a view."""
    return {"op": "views", "count": n_slot, **{k: OP[k] for k in ("open", "token")}, "repeat": n_token, "close": OP["close"]}


def read_prompt(tokenizer: TokenizerPlan, pad_token: str, n_slot: int, n_token: int, problems: Problems) -> Prompt:
    keys = {key.name: key.value for key in tokenizer.keys}
    added = {token["content"]: token for token in json.loads(keys["tokenizer.added"])}
    image, pad = _special(added, problems), added.get(pad_token, {}).get("id", -1)
    if pad < 0:
        problems.add("tokenizer_config.json: pad_token", "one of the added tokens", repr(pad_token), PAD_HINT)
    texts = [("\n" if i else "") + OP["open"].replace("{i}", str(i + 1))[: -len(OPEN)] for i in range(n_slot)]
    for content in added:
        if content not in (IMAGE, OPEN, CLOSE) and any(content in text for text in (*texts, IMAGE + OPEN + CLOSE)):
            problems.unsupported("tokenizer: added token " + repr(content), "no added token within the prompt's own words", "one")
    encoder = Encoder(keys["tokenizer.tokens"], keys["tokenizer.merges"])
    starts: List[int] = []
    position = 0
    for text in texts:
        position += len(encoder.ids(text)) + 1  # <img>
        starts.append(position)
        position += n_token + 1  # </img>
    return Prompt(starts, max(pad, 0), image)


def _special(added: Dict[str, dict], problems: Problems) -> int:
    """The three tokens around and of a view stand for themselves wherever they occur."""
    for text in (OPEN, IMAGE, CLOSE):
        token = added.get(text)
        if token is None or token["id"] < 0 or any(token[flag] for flag in ("lstrip", "rstrip", "single_word")):
            problems.add(
                "tokenizer: added token " + text,
                "a token that takes no blanks around it",
                "none" if token is None else json.dumps(token)[:120],
                "--backbone needs the folder of the InternVL3 backbone",
            )
    return added.get(IMAGE, {}).get("id", -1)


class Encoder:
    """Byte-level BPE of ASCII text."""

    def __init__(self, tokens: List[str], merges: List[str]) -> None:
        self.symbols = byte_symbols()
        self.id_of = {text: number for number, text in enumerate(tokens)}
        self.ranks: Dict[Tuple[str, ...], int] = {tuple(merge.split(" ")): rank for rank, merge in enumerate(merges)}

    def ids(self, text: str) -> List[int]:
        return [self.id_of.get(part, -1) for word in WORDS.findall(text) for part in self.word(word)]

    def word(self, word: str) -> List[str]:
        parts = [self.symbols[byte] for byte in word.encode("ascii")]
        while len(parts) > 1:
            pairs = list(zip(parts, parts[1:]))
            rank, at = min((self.ranks.get(pair, len(self.ranks)), i) for i, pair in enumerate(pairs))
            if rank == len(self.ranks):
                break
            # Every occurrence of the pair merges, from the left.
            pair, merged, i = pairs[at], [], 0
            while i < len(parts):
                step = 2 if tuple(parts[i : i + 2]) == pair else 1
                merged.append("".join(parts[i : i + step]))
                i += step
            parts = merged
        return parts

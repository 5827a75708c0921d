# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Tokenizes the fixed words of a prompt. No instruction changes their tokens, so they determine the positions of the image tokens.

These words are ASCII without digits, so that Python's `re` can express the splitting rules of Qwen2 and Llama 3.
"""

from __future__ import annotations

import json
import re
from typing import Dict, List, Sequence, Tuple

from .bundle import Key
from .errors import Problems
from .tokenizer_byte_level import byte_symbols

WORDS = re.compile(
    r"'(?:[sS]|[tT]|[rR][eE]|[vV][eE]|[mM]|[lL][lL]|[dD])|[^\r\nA-Za-z0-9]?[A-Za-z]+|[0-9]"
    r"| ?[^\sA-Za-z0-9]+[\r\n]*|\s*[\r\n]+|\s+(?!\S)|\s+"
)


def special_ids(keys: Sequence[Key], texts: Sequence[str], hint: str, problems: Problems) -> List[int]:
    """Ids of added tokens that match exactly their text, wherever it occurs. Reports missing tokens, with the id -1, and tokens that
    take blanks around them."""
    added: Dict[str, dict] = {token["content"]: token for token in json.loads(_value(keys, "tokenizer.added"))}
    for text in texts:
        token = added.get(text)
        if token is None or token["id"] < 0 or any(token[flag] for flag in ("lstrip", "rstrip", "single_word")):
            found = "none" if token is None else json.dumps(token)[:120]
            problems.add("tokenizer: added token " + text, "a token that takes no blanks around it", found, hint)
    return [added.get(text, {}).get("id", -1) for text in texts]


def check_undivided(keys: Sequence[Key], own: Sequence[str], texts: Sequence[str], problems: Problems) -> None:
    """Refuses added tokens, except the prompt's `own`, that occur in the fixed words `texts` of the prompt."""
    for token in json.loads(_value(keys, "tokenizer.added")):
        content = token["content"]
        if content not in own and any(content in text for text in texts):
            problems.unsupported("tokenizer: added token " + repr(content), "no added token within the prompt's own words", "one")


def _value(keys: Sequence[Key], name: str):
    return next(key.value for key in keys if key.name == name)


class Encoder:
    """Byte-level BPE of ASCII text."""

    def __init__(self, keys: Sequence[Key]) -> None:
        self.symbols = byte_symbols()
        self.whole_words = _value(keys, "tokenizer.ignore_merges")
        self.id_of = {text: number for number, text in enumerate(_value(keys, "tokenizer.tokens"))}
        self.ranks = ranks_of(keys)

    def ids(self, text: str) -> List[int]:
        return [self.id_of.get(part, -1) for word in WORDS.findall(text) for part in self.word(word)]

    def word(self, word: str) -> List[str]:
        parts = [self.symbols[byte] for byte in word.encode("ascii")]
        if self.whole_words and "".join(parts) in self.id_of:
            return ["".join(parts)]
        return merge_all(parts, self.ranks)


def ranks_of(keys: Sequence[Key]) -> Dict[Tuple[str, ...], int]:
    return {tuple(merge.split(" ")): rank for rank, merge in enumerate(_value(keys, "tokenizer.merges"))}


def merge_all(parts: List[str], ranks: Dict[Tuple[str, ...], int]) -> List[str]:
    while len(parts) > 1:
        pairs = list(zip(parts, parts[1:]))
        rank, at = min((ranks.get(pair, len(ranks)), i) for i, pair in enumerate(pairs))
        if rank == len(ranks):
            break
        # Merges every occurrence of the pair, from the left.
        pair, merged, i = pairs[at], [], 0
        while i < len(parts):
            step = 2 if tuple(parts[i : i + 2]) == pair else 1
            merged.append("".join(parts[i : i + step]))
            i += step
        parts = merged
    return parts

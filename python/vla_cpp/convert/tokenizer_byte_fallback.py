# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""BPE with byte fallback: the tokenizers of Gemma, PaliGemma and Llama 2.

One rule normalizes text: blanks become U+2581. Text is not split: the pre-tokenizer in Gemma's file splits at blanks, but none are left.
transformers' GemmaTokenizer builds the same from vocabulary and merges. Llama 2's file also adds a U+2581 before every text between added
tokens.
"""

from __future__ import annotations

from typing import List

from .bundle import Key
from .errors import Problems
from .files import member
from .tokenizer_parts import GENERIC, JSON_FILE, Tokenizer, check_class, check_model, check_symbols, one_or_sequence, prefix_ids, to_json

KIND = "byte_fallback_bpe"
GEMMA = ("GemmaTokenizer", "GemmaTokenizerFast")
GEMMA_TOKENS = {"unk_token": "<unk>", "bos_token": "<bos>", "eos_token": "<eos>", "pad_token": "<pad>", "mask_token": "<mask>"}
BYTES = ["<0x{:02X}>".format(byte) for byte in range(256)]
MODEL = {
    "type": ("BPE",),
    "dropout": (None, 0, 0.0),
    "continuing_subword_prefix": (None, ""),
    "end_of_word_suffix": (None, ""),
    "ignore_merges": (False, None),
}
BLANK = {"String": " "}
NORMALIZER = [{"type": "Replace", "pattern": BLANK, "content": "\u2581"}]
BLANK_FIRST = [{"type": "Prepend", "prepend": "\u2581"}, *NORMALIZER]


def with_defaults(config: dict) -> dict:
    """The config with the default special tokens of its class, which the class adds to the vocabulary like stated ones."""
    return dict(GEMMA_TOKENS, **config) if config.get("tokenizer_class") in GEMMA else config


def keys(tokenizer: Tokenizer, problems: Problems, notes: List[str]) -> List[Key]:
    check_model(tokenizer.model, MODEL, "byte-level BPE and BPE with byte fallback", problems)
    check_symbols(tokenizer.model, _needed_bytes(member(tokenizer.model, "vocab", dict, JSON_FILE)), problems)
    check_class(tokenizer.config, GENERIC + GEMMA, problems)
    spec = tokenizer.spec
    steps = one_or_sequence(spec.get("normalizer"), "normalizers")
    if steps not in (NORMALIZER, BLANK_FIRST):
        problems.unsupported(
            JSON_FILE + ": normalizer",
            "blanks replaced by U+2581, and at most one in front of them before",
            to_json(spec.get("normalizer"))[:120],
            "the runtime does not normalize text otherwise",
        )
    for step in one_or_sequence(spec.get("pre_tokenizer"), "pretokenizers"):
        if not isinstance(step, dict) or step.get("type") != "Split" or step.get("pattern") != BLANK:
            problems.unsupported(JSON_FILE + ": pre_tokenizer", "none, or Split at blanks, which are gone by then", to_json(step)[:120])
    _check_characters(tokenizer, problems)
    blank_first = [Key("tokenizer.normalization", "string", "blank_first")] if steps == BLANK_FIRST else []
    return [*blank_first, Key("tokenizer.prefix_ids", "u32[]", prefix_ids(tokenizer, problems))]


def _needed_bytes(vocab: dict) -> List[str]:
    """The byte tokens that the vocabulary must have. A character that is itself a token needs none: in Gemma's file the tab has the place
    of <0x09>."""
    return [symbol for byte, symbol in enumerate(BYTES) if byte > 0x7F or chr(byte) not in vocab]


def _check_characters(tokenizer: Tokenizer, problems: Problems) -> None:
    """Refuses an added token of one character that is not in the model's vocabulary: a bundle does not state whether an added token is also
    a symbol of the model, so a single character must be both."""
    vocab = member(tokenizer.model, "vocab", dict, JSON_FILE)
    for token in tokenizer.added:
        if len(token["content"]) == 1 and token["content"] not in vocab:
            problems.unsupported(
                JSON_FILE + ": added_tokens", "single characters that the model's vocabulary has too", repr(token["content"])
            )

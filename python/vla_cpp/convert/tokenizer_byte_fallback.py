# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""BPE with byte fallback: what Gemma and PaliGemma publish.

Text is normalised by one rule, blanks to U+2581, and is not split at all: the pre-tokenizer of the published file splits at blanks,
of which none are left. transformers' GemmaTokenizer builds the same around vocabulary and merges.
"""

from __future__ import annotations

from typing import List

from .bundle import Key
from .errors import Problems
from .files import member
from .tokenizer_parts import (
    CONFIG_FILE,
    GENERIC,
    JSON_FILE,
    Tokenizer,
    check_class,
    check_model,
    check_symbols,
    one_or_sequence,
    to_json,
)

KIND = "byte_fallback_bpe"
GEMMA = ("GemmaTokenizer", "GemmaTokenizerFast")
GEMMA_TOKENS = {
    "unk_token": "<unk>",
    "bos_token": "<bos>",
    "eos_token": "<eos>",
    "pad_token": "<pad>",
    "mask_token": "<mask>",
}
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


def with_defaults(config: dict) -> dict:
    """The class's own defaults, which it adds to the vocabulary like stated ones."""
    return dict(GEMMA_TOKENS, **config) if config.get("tokenizer_class") in GEMMA else config


def keys(tokenizer: Tokenizer, problems: Problems, notes: List[str]) -> List[Key]:
    check_model(tokenizer.model, MODEL, "byte-level BPE and BPE with byte fallback", problems)
    check_symbols(tokenizer.model, _needed_bytes(member(tokenizer.model, "vocab", dict, JSON_FILE)), problems)
    check_class(tokenizer.config, GENERIC + GEMMA, problems)
    spec = tokenizer.spec
    if one_or_sequence(spec.get("normalizer"), "normalizers") != NORMALIZER:
        problems.unsupported(
            JSON_FILE + ": normalizer",
            "blanks replaced by U+2581 and nothing else",
            to_json(spec.get("normalizer"))[:120],
            "the runtime does not normalise text otherwise",
        )
    for step in one_or_sequence(spec.get("pre_tokenizer"), "pretokenizers"):
        if not isinstance(step, dict) or step.get("type") != "Split" or step.get("pattern") != BLANK:
            problems.unsupported(
                JSON_FILE + ": pre_tokenizer", "none, or Split at blanks, which are gone by then", to_json(step)[:120]
            )
    _check_characters(tokenizer, problems)
    return [Key("tokenizer.prefix_ids", "u32[]", _prefix(tokenizer, problems))]


def _needed_bytes(vocab: dict) -> List[str]:
    """A character that is a token never falls back to its byte: in Gemma's file the tab stands where <0x09> would be."""
    return [symbol for byte, symbol in enumerate(BYTES) if byte > 0x7F or chr(byte) not in vocab]


def _check_characters(tokenizer: Tokenizer, problems: Problems) -> None:
    """A bundle does not say whether an added token is also a symbol of the model, so a single character must be both."""
    vocab = member(tokenizer.model, "vocab", dict, JSON_FILE)
    for token in tokenizer.added:
        if len(token["content"]) == 1 and token["content"] not in vocab:
            problems.unsupported(
                JSON_FILE + ": added_tokens",
                "single characters that the model's vocabulary has too",
                repr(token["content"]),
            )


def _prefix(tokenizer: Tokenizer, problems: Problems) -> List[int]:
    """The ids in front of every text: those of the file's template. transformers 5.5 reads add_bos_token and add_eos_token of the
    config and then keeps the template all the same; a config that contradicts it may mean another release."""
    config = tokenizer.config
    ids = _template(tokenizer, problems)
    if config.get("add_eos_token", False) not in (False, None):
        problems.unsupported(CONFIG_FILE + ": add_eos_token", "False", repr(config["add_eos_token"]))
    if config.get("add_bos_token") is not None and bool(config["add_bos_token"]) != bool(ids):
        problems.add(
            CONFIG_FILE + ": add_bos_token",
            "{}, as the template of {} has it".format(bool(ids), JSON_FILE),
            repr(config["add_bos_token"]),
            "load the tokenizer with transformers and save it again",
        )
    return ids


def _template(tokenizer: Tokenizer, problems: Problems) -> List[int]:
    post = tokenizer.spec.get("post_processor")
    if post is None:
        return []
    single = post.get("single") if isinstance(post, dict) else None
    parts = single if isinstance(single, list) and post.get("type") == "TemplateProcessing" else []
    kinds = [next(iter(part), None) if isinstance(part, dict) else None for part in parts]
    if kinds != ["SpecialToken"] * (len(parts) - 1) + ["Sequence"]:
        problems.unsupported(
            JSON_FILE + ": post_processor", "a template of special tokens and then the text", to_json(post)[:120]
        )
        return []
    special = member(post, "special_tokens", dict, JSON_FILE)
    ids: List[int] = []
    for part in parts[:-1]:
        name = member(part, "SpecialToken", dict, JSON_FILE).get("id")
        ids += member(member(special, name, dict, JSON_FILE) if isinstance(name, str) else {}, "ids", list, JSON_FILE)
    if not all(isinstance(i, int) and 0 <= i < tokenizer.n_vocab for i in ids):
        problems.add(JSON_FILE + ": post_processor.special_tokens", "ids below {}".format(tokenizer.n_vocab), str(ids))
    return ids

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Byte-level BPE: what SmolLM2 and the other descendants of GPT-2 publish.

Which pre-tokenizer counts follows the class that transformers 5.4 to 5.5 builds for `tokenizer_class`: the generic classes keep
tokenizer.json as it is, GPT2Tokenizer and Qwen2Tokenizer take vocabulary and merges from it and bring the rest themselves.
"""

from __future__ import annotations

from typing import List, Tuple

from .bundle import Key
from .errors import Problems
from .files import member
from .tokenizer_parts import (
    CONFIG_FILE,
    GENERIC,
    JSON_FILE,
    Tokenizer,
    check_class,
    check_ids,
    check_model,
    check_symbols,
    one_or_sequence,
    to_json,
)

KIND = "byte_level_bpe"
GPT2 = ("GPT2Tokenizer", "GPT2TokenizerFast")
QWEN2 = ("Qwen2Tokenizer", "Qwen2TokenizerFast")
QWEN2_WORDS = (
    r"(?i:'s|'t|'re|'ve|'m|'ll|'d)|[^\r\n\p{L}\p{N}]?\p{L}+|\p{N}| ?[^\s\p{L}\p{N}]+[\r\n]*|\s*[\r\n]+|\s+(?!\S)|\s+"
)
NFC = {"type": "NFC"}
MODEL = {
    "type": ("BPE",),
    "dropout": (None, 0, 0.0),
    "continuing_subword_prefix": (None, ""),
    "end_of_word_suffix": (None, ""),
    "byte_fallback": (False, None),
}


def byte_symbols() -> List[str]:
    """The 256 printable characters that stand for bytes in byte-level vocabularies (as GPT-2 defined them)."""
    kept = [*range(ord("!"), ord("~") + 1), *range(0xA1, 0xAC + 1), *range(0xAE, 0xFF + 1)]
    moved = {byte: 256 + i for i, byte in enumerate(b for b in range(256) if b not in kept)}
    return [chr(moved.get(byte, byte)) for byte in range(256)]


def with_defaults(config: dict) -> dict:
    """The class's own defaults, which it adds to the vocabulary like stated ones."""
    own = {GPT2: ("unk_token", "bos_token", "eos_token"), QWEN2: ("unk_token", "eos_token", "pad_token")}
    for names, keys in own.items():
        if config.get("tokenizer_class") in names:
            return dict(dict.fromkeys(keys, "<|endoftext|>"), **config)
    return config


def keys(tokenizer: Tokenizer, problems: Problems, notes: List[str]) -> List[Key]:
    check_model(tokenizer.model, MODEL, "byte-level BPE and BPE with byte fallback", problems)
    check_symbols(tokenizer.model, byte_symbols(), problems)
    _check_surroundings(tokenizer, problems)
    pre, config = _pre_tokenizer(tokenizer.spec.get("pre_tokenizer"), problems), tokenizer.config
    nfc, name = _normalization(tokenizer.spec.get("normalizer"), problems), config.get("tokenizer_class")
    if name in GPT2 or name in QWEN2:
        own = _of_class(name in QWEN2, bool(config.get("add_prefix_space") or False))
        if (pre, nfc) != own:
            notes.append(
                "{} names {}: transformers 5 then replaces normalizer and pre-tokenizer of {} by the class's own, and so does the bundle".format(
                    CONFIG_FILE, name, JSON_FILE
                )
            )
        pre, nfc = own
    else:
        own = None
    return [
        Key("tokenizer.pre", "string", to_json(pre)),
        *([Key("tokenizer.normalization", "string", "nfc")] if nfc else []),
        Key("tokenizer.ignore_merges", "bool", bool(tokenizer.model.get("ignore_merges", False)) and own is None),
    ]


def _of_class(qwen2: bool, prefix_space: bool) -> Tuple[List[dict], bool]:
    """The steps that a class brings, and whether it composes characters."""
    split = [{"type": "split", "pattern": QWEN2_WORDS}] if qwen2 else []
    return [*split, {"type": "byte_level", "add_prefix_space": prefix_space, "use_regex": not qwen2}], qwen2


def _normalization(normalizer, problems: Problems) -> bool:
    """Whether text is composed to NFC; other normalizers are refused."""
    steps = one_or_sequence(normalizer, "normalizers")
    if any(step != NFC for step in steps):
        hint = "the runtime knows no other normalization"
        problems.unsupported(JSON_FILE + ": normalizer", "none or NFC", to_json(normalizer)[:80], hint)
    return bool(steps)


def _check_surroundings(tokenizer: Tokenizer, problems: Problems) -> None:
    spec, config = tokenizer.spec, tokenizer.config
    if not _adds_nothing(spec.get("post_processor")):
        problems.unsupported(
            JSON_FILE + ": post_processor",
            "none, ByteLevel, or a template of the text alone",
            to_json(spec["post_processor"])[:80],
        )
    check_class(config, GENERIC + GPT2 + QWEN2, problems)
    for key in ("add_bos_token", "add_eos_token"):
        if config.get(key, False) not in (False, None):
            problems.unsupported("{}: {}".format(CONFIG_FILE, key), "False", repr(config[key]))
    check_ids({token["content"]: token["id"] for token in tokenizer.added}, tokenizer.n_vocab, problems)


def _adds_nothing(post) -> bool:
    """Whether a post-processor leaves the ids alone (ByteLevel only trims offsets)."""
    if post is None:
        return True
    kind = post.get("type") if isinstance(post, dict) else None
    if kind == "Sequence":
        return all(_adds_nothing(part) for part in member(post, "processors", list, JSON_FILE))
    if kind == "TemplateProcessing":
        single = post.get("single")
        return single in ([{"Sequence": {"id": "A"}}], [{"Sequence": {"id": "A", "type_id": 0}}])
    return kind == "ByteLevel"


def _pre_tokenizer(pre, problems: Problems) -> List[dict]:
    parts = one_or_sequence(pre, "pretokenizers") or [pre]
    steps = []
    for part in parts:
        kind = part.get("type") if isinstance(part, dict) else None
        if kind == "Digits" and set(part) <= {"type", "individual_digits"}:
            steps.append({"type": "digits", "individual": bool(part.get("individual_digits", False))})
        elif part == {"type": "Split", "pattern": {"Regex": QWEN2_WORDS}, "behavior": "Isolated", "invert": False}:
            steps.append({"type": "split", "pattern": QWEN2_WORDS})
        elif kind == "ByteLevel" and set(part) <= {"type", "add_prefix_space", "trim_offsets", "use_regex"}:
            steps.append(
                {
                    "type": "byte_level",
                    "add_prefix_space": bool(part.get("add_prefix_space", True)),
                    "use_regex": bool(part.get("use_regex", True)),
                }
            )
        else:
            problems.unsupported(
                JSON_FILE + ": pre_tokenizer",
                "Digits, ByteLevel and the Split of Qwen2",
                to_json(part)[:80],
                "the runtime implements these",
            )
            return []
    if [step["type"] for step in steps].count("byte_level") != 1 or steps[-1]["type"] != "byte_level":
        problems.unsupported(JSON_FILE + ": pre_tokenizer", "ByteLevel once, as the last step", to_json(pre)[:80])
    return steps

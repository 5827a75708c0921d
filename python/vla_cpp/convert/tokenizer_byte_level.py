# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Byte-level BPE: the tokenizers of SmolLM2, Qwen2, BART and other descendants of GPT-2.

The class that transformers 5.4 to 5.5 builds for `tokenizer_class` determines pre-tokenizer and normalizer: generic classes use those in
tokenizer.json; GPT2Tokenizer, Qwen2Tokenizer and BartTokenizer read only vocabulary and merges from the file and have their own.
"""

from __future__ import annotations

from typing import List, NamedTuple, Optional, Tuple

from .bundle import Key
from .errors import Problems
from .tokenizer_parts import (
    CONFIG_FILE,
    GENERIC,
    JSON_FILE,
    Tokenizer,
    check_class,
    check_ids,
    check_model,
    check_symbols,
    class_around,
    one_or_sequence,
    prefix_ids,
    stated_around,
    to_json,
)

KIND = "byte_level_bpe"
GPT2 = ("GPT2Tokenizer", "GPT2TokenizerFast")
QWEN2 = ("Qwen2Tokenizer", "Qwen2TokenizerFast")
BART = ("BartTokenizer", "BartTokenizerFast", "RobertaTokenizer", "RobertaTokenizerFast")  # one class with several names
# The splitting expressions of Qwen2 and Llama 3, the same as in src/processor/pretokenizer.h.
QWEN2_WORDS = r"(?i:'s|'t|'re|'ve|'m|'ll|'d)|[^\r\n\p{L}\p{N}]?\p{L}+|\p{N}| ?[^\s\p{L}\p{N}]+[\r\n]*|\s*[\r\n]+|\s+(?!\S)|\s+"
LLAMA3_WORDS = QWEN2_WORDS.replace(r"|\p{N}|", r"|\p{N}{1,3}|")
SPLITS = {
    words: {"type": "Split", "pattern": {"Regex": words}, "behavior": "Isolated", "invert": False} for words in (QWEN2_WORDS, LLAMA3_WORDS)
}
# Default special tokens of the classes.
DEFAULTS = {
    **dict.fromkeys(GPT2, dict.fromkeys(("unk_token", "bos_token", "eos_token"), "<|endoftext|>")),
    **dict.fromkeys(QWEN2, dict.fromkeys(("unk_token", "eos_token", "pad_token"), "<|endoftext|>")),
    **dict.fromkeys(
        BART,
        {
            **dict.fromkeys(("bos_token", "cls_token"), "<s>"),
            **dict.fromkeys(("eos_token", "sep_token"), "</s>"),
            **{name + "_token": "<{}>".format(name) for name in ("unk", "pad", "mask")},
        },
    ),
}
MODEL = {
    "type": ("BPE",),
    "dropout": (None, 0, 0.0),
    "continuing_subword_prefix": (None, ""),
    "end_of_word_suffix": (None, ""),
    "byte_fallback": (False, None),
}


def byte_symbols() -> List[str]:
    """The 256 printable characters that represent bytes in byte-level vocabularies (defined by GPT-2)."""
    kept = [*range(ord("!"), ord("~") + 1), *range(0xA1, 0xAC + 1), *range(0xAE, 0xFF + 1)]
    moved = {byte: 256 + i for i, byte in enumerate(b for b in range(256) if b not in kept)}
    return [chr(moved.get(byte, byte)) for byte in range(256)]


def with_defaults(config: dict) -> dict:
    """The config with the default special tokens of its class, which the class adds to the vocabulary like stated ones."""
    return dict(DEFAULTS.get(str(config.get("tokenizer_class")), {}), **config)


class _Splitting(NamedTuple):
    pre: List[dict]  # the steps of `tokenizer.pre`
    normalization: Optional[str]


def keys(tokenizer: Tokenizer, problems: Problems, notes: List[str]) -> List[Key]:
    check_model(tokenizer.model, MODEL, "byte-level BPE and BPE with byte fallback", problems)
    check_symbols(tokenizer.model, byte_symbols(), problems)
    _check_surroundings(tokenizer, problems)
    spec, config = tokenizer.spec, tokenizer.config
    front, behind = _around(tokenizer, problems, notes)
    splitting = _Splitting(_pre_tokenizer(spec.get("pre_tokenizer"), problems), _normalization(spec.get("normalizer"), problems))
    own = _of_class(config)
    if own is not None and own != splitting:
        notes.append(
            "{} names {}: transformers 5 then splits text as that class does and not as {} says, and so does the bundle".format(
                CONFIG_FILE, config["tokenizer_class"], JSON_FILE
            )
        )
    splitting = own or splitting
    normalization = [Key("tokenizer.normalization", "string", splitting.normalization)] if splitting.normalization else []
    return [
        Key("tokenizer.pre", "string", to_json(splitting.pre)),
        *normalization,
        *([Key("tokenizer.prefix_ids", "u32[]", front)] if front else []),
        *([Key("tokenizer.suffix_ids", "u32[]", behind)] if behind else []),
        Key("tokenizer.ignore_merges", "bool", bool(tokenizer.model.get("ignore_merges", False)) and own is None),
    ]


def _around(tokenizer: Tokenizer, problems: Problems, notes: List[str]) -> Tuple[List[int], List[int]]:
    """The ids before and after every text. BART's class builds this template itself."""
    config, post = tokenizer.config, tokenizer.spec.get("post_processor")
    is_bart = isinstance(post, dict) and post.get("type") == "RobertaProcessing" and config.get("tokenizer_class") not in GPT2 + QWEN2
    if not is_bart and config.get("tokenizer_class") not in BART:
        return prefix_ids(tokenizer, problems), []
    around = stated_around(tokenizer, problems, "a template of special tokens around the text", may_follow=True)
    return class_around(tokenizer, around, problems, notes) if config.get("tokenizer_class") in BART else around


def _of_class(config: dict) -> Optional[_Splitting]:
    name, prefix_space = config.get("tokenizer_class"), bool(config.get("add_prefix_space") or False)
    if name in GPT2 + BART:
        return _Splitting([_byte_level(prefix_space, True)], None)
    if name in QWEN2:
        return _Splitting([{"type": "split", "pattern": QWEN2_WORDS}, _byte_level(prefix_space, False)], "nfc")
    return None


def _byte_level(prefix_space: bool, use_regex: bool) -> dict:
    return {"type": "byte_level", "add_prefix_space": prefix_space, "use_regex": use_regex}


def _normalization(normalizer, problems: Problems) -> Optional[str]:
    steps = one_or_sequence(normalizer, "normalizers")
    if steps not in ([], [{"type": "NFC"}]):
        problems.unsupported(JSON_FILE + ": normalizer", "none or NFC", to_json(normalizer)[:80], "the runtime implements these two")
    return "nfc" if steps else None


def _check_surroundings(tokenizer: Tokenizer, problems: Problems) -> None:
    check_class(tokenizer.config, GENERIC + GPT2 + QWEN2 + BART, problems)
    check_ids({token["content"]: token["id"] for token in tokenizer.added}, tokenizer.n_vocab, problems)


def _pre_tokenizer(pre, problems: Problems) -> List[dict]:
    parts = one_or_sequence(pre, "pretokenizers") or [pre]
    steps = []
    for part in parts:
        kind = part.get("type") if isinstance(part, dict) else None
        if kind == "Digits" and set(part) <= {"type", "individual_digits"}:
            steps.append({"type": "digits", "individual": bool(part.get("individual_digits", False))})
        elif kind == "ByteLevel" and set(part) <= {"type", "add_prefix_space", "trim_offsets", "use_regex"}:
            steps.append(_byte_level(bool(part.get("add_prefix_space", True)), bool(part.get("use_regex", True))))
        elif part in SPLITS.values():
            steps.append({"type": "split", "pattern": part["pattern"]["Regex"]})
        else:
            problems.unsupported(
                JSON_FILE + ": pre_tokenizer",
                "Digits, the Split of Qwen2 or Llama 3 and ByteLevel",
                to_json(part)[:80],
                "the runtime implements these",
            )
            return []
    if [step["type"] for step in steps].count("byte_level") != 1 or steps[-1]["type"] != "byte_level":
        problems.unsupported(JSON_FILE + ": pre_tokenizer", "ByteLevel once, as the last step", to_json(pre)[:80])
    return steps

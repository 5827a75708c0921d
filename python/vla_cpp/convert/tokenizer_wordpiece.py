# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""WordPiece: BERT's tokenizer, for text without capitals and accents.

transformers' BertTokenizer reads only the vocabulary from tokenizer.json, and builds normalization, splitting and template from the settings
in tokenizer_config.json. The two files must agree.
"""

from __future__ import annotations

from typing import List

from .bundle import Key
from .errors import Problems
from .files import member
from .tokenizer_parts import CONFIG_FILE, GENERIC, JSON_FILE, Tokenizer, around_ids, check_class, check_model, class_around, to_json

KIND = "wordpiece"
BERT = ("BertTokenizer", "BertTokenizerFast")
MODEL = {"type": ("WordPiece",), "continuing_subword_prefix": ("##",), "max_input_chars_per_word": (100,)}
NORMALIZER = {"clean_text": (True,), "handle_chinese_chars": (True,), "strip_accents": (None, True), "lowercase": (True,)}
CONFIG = {
    "do_lower_case": (True,),
    "tokenize_chinese_chars": (True,),
    "strip_accents": (None, True),
    "do_basic_tokenize": (True,),
    "never_split": (None, []),
}
TOKENS = {name + "_token": "[{}]".format(name.upper()) for name in ("unk", "sep", "pad", "cls", "mask")}


def untyped(model: dict) -> str:
    """The type of a model without a stated type, as in files of older releases: "WordPiece" if the model has its fields, else ""."""
    return "WordPiece" if "max_input_chars_per_word" in model and "continuing_subword_prefix" in model else ""


def with_defaults(config: dict) -> dict:
    """The config with the default special tokens of its class, which the class adds to the vocabulary like stated ones."""
    return dict(TOKENS, **config) if config.get("tokenizer_class") in BERT else config


def keys(tokenizer: Tokenizer, problems: Problems, notes: List[str]) -> List[Key]:
    check_model(
        {"type": untyped(tokenizer.model), **tokenizer.model}, MODEL, "byte-level BPE, BPE with byte fallback and WordPiece", problems
    )
    check_class(tokenizer.config, GENERIC + BERT, problems)
    _check_settings(tokenizer.spec.get("normalizer"), "normalizer", "BertNormalizer", problems)
    _check_settings(tokenizer.spec.get("pre_tokenizer"), "pre_tokenizer", "BertPreTokenizer", problems)
    for key, values in CONFIG.items():
        if tokenizer.config.get(key, values[0]) not in values:
            problems.unsupported("{}: {}".format(CONFIG_FILE, key), repr(values[0]), repr(tokenizer.config[key]))
    _check_words(tokenizer, problems)
    front, behind = around_ids(tokenizer, problems, "a template of special tokens around the text", may_follow=True)
    if tokenizer.config.get("tokenizer_class") in BERT:
        front, behind = class_around(tokenizer, (front, behind), problems, notes)
    return [
        Key("tokenizer.normalization", "string", "bert_uncased"),
        Key("tokenizer.prefix_ids", "u32[]", front),
        Key("tokenizer.suffix_ids", "u32[]", behind),
        Key("tokenizer.unknown_id", "u32", _unknown(tokenizer, problems)),
    ]


def _check_settings(step, name: str, kind: str, problems: Problems) -> None:
    settings = step if isinstance(step, dict) else {}
    allowed = NORMALIZER if kind == "BertNormalizer" else {}
    right = settings.get("type") == kind and all(settings.get(key) in values for key, values in allowed.items())
    if not right:
        wanted = "{} with {}".format(kind, to_json({key: values[0] for key, values in allowed.items()})) if allowed else kind
        problems.unsupported("{}: {}".format(JSON_FILE, name), wanted, to_json(step)[:120], "a model of cased text is not supported")


def _check_words(tokenizer: Tokenizer, problems: Problems) -> None:
    """Refuses added tokens that are also plain words of the model's vocabulary: a bundle does not state that a token is both."""
    vocab = member(tokenizer.model, "vocab", dict, JSON_FILE)
    for token in tokenizer.added:
        content = token["content"]
        if content in vocab and not (content.startswith("[") and content.endswith("]")):
            problems.unsupported(JSON_FILE + ": added_tokens", "words that the model's vocabulary does not have, or [NAME]", repr(content))


def _unknown(tokenizer: Tokenizer, problems: Problems) -> int:
    vocab, name = member(tokenizer.model, "vocab", dict, JSON_FILE), tokenizer.model.get("unk_token")
    if isinstance(name, str) and isinstance(vocab.get(name), int):
        return vocab[name]
    problems.add(JSON_FILE + ": model.unk_token", "a token of the vocabulary", repr(name))
    return 0

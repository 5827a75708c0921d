# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Converts tokenizer.json, or the older files in its place, to the keys of a bundle, after checking that the runtime implements the tokenizer.

Three kinds are supported, each with its own module: byte-level BPE, BPE with byte fallback, and WordPiece. tokenizer_parts.py has their
common parts.
"""

from __future__ import annotations

import os
from typing import List, NamedTuple, Sequence, Tuple

from . import tokenizer_byte_fallback, tokenizer_byte_level, tokenizer_sentencepiece, tokenizer_vocab_files, tokenizer_wordpiece
from .bundle import Key
from .errors import Code, Problems, refuse
from .files import member, read_json
from .tokenizer_parts import (
    CONFIG_FILE,
    GENERIC,
    JSON_FILE,
    Tokenizer,
    add_special,
    added_tokens,
    check_config_tokens,
    merges_of,
    to_json,
    vocabulary,
)

MODEL_FILE = "config.json"
# transformers 5.5: the tokenizer's class by model_type, for the models whose tokenizers this converter supports.
CLASSES = {
    "bart": "RobertaTokenizer",
    "bert": "BertTokenizer",
    "florence2": "BartTokenizer",
    "gpt2": "GPT2Tokenizer",
    **dict.fromkeys(("gemma", "gemma2"), "GemmaTokenizer"),
    **dict.fromkeys(("internvl_chat", "llava", "openvla"), GENERIC[0]),
    **dict.fromkeys(("internvl", "qwen2", "qwen2_5_vl", "qwen2_vl", "qwen3", "qwen3_vl"), "Qwen2Tokenizer"),
}
NO_ROW = -1  # id of an added token without a row in the embedding


class TokenizerPlan(NamedTuple):
    keys: List[Key]  # the bundle's `tokenizer.*`
    truncate: str  # the side on which a too long text loses tokens: left or right
    n_own: int  # number of the model's own tokens, without added ones: transformers' vocab_size

    @property
    def tokens(self) -> List[str]:
        """Texts of the tokens, by id."""
        return next(key.value for key in self.keys if key.name == "tokenizer.tokens")


def read_tokenizer(folder: str, n_vocab: int, problems: Problems, notes: List[str], more: Sequence[str] = ()) -> TokenizerPlan:
    """Reads the tokenizer in a folder. `n_vocab`: rows of the embedding table; ids must be smaller. `more`: special tokens that the
    reference's own code adds."""
    spec, config = _read_files(folder, problems, notes)
    model = member(spec, "model", dict, JSON_FILE)
    kind = _kind(model)
    config = kind.with_defaults(_with_class(folder, config))
    added = added_tokens(spec, model, config, problems, notes)
    check_config_tokens(config, added, problems)
    add_special(added, model, more, problems)
    tokenizer = Tokenizer(spec, config, model, added, n_vocab)
    own = kind.keys(tokenizer, problems, notes)
    tokens = vocabulary(tokenizer, problems)
    keys = [
        Key("tokenizer.kind", "string", kind.KIND),
        Key("tokenizer.tokens", "string[]", tokens),
        Key("tokenizer.added", "string", to_json(_with_rows(added, n_vocab))),
        *own,
    ]
    if kind is not tokenizer_wordpiece:
        keys.insert(2, Key("tokenizer.merges", "string[]", merges_of(model.get("merges"), model["vocab"], problems)))
    return TokenizerPlan(keys, _truncation_side(spec, config, problems), len(model["vocab"]))


def _kind(model: dict):
    if model.get("type", tokenizer_wordpiece.untyped(model)) == "WordPiece":
        return tokenizer_wordpiece
    return tokenizer_byte_fallback if model.get("byte_fallback") is True else tokenizer_byte_level


def _read_files(folder: str, problems: Problems, notes: List[str]) -> Tuple[dict, dict]:
    """tokenizer.json, or its equivalent from older files; and tokenizer_config.json."""
    path, config_path = os.path.join(folder, JSON_FILE), os.path.join(folder, CONFIG_FILE)
    pieces = tokenizer_sentencepiece.find(folder)
    config = read_json(config_path) if os.path.exists(config_path) else {}
    if os.path.exists(path):
        return read_json(path), config
    if tokenizer_vocab_files.present(folder):
        notes.append("tokenizer: from vocab.json and merges.txt, as transformers makes {} of them".format(JSON_FILE))
        return tokenizer_vocab_files.read_spec(folder, config, problems), config
    if pieces is None:
        raise refuse(
            path,
            "the tokenizer in one file",
            "none, no {}, and no vocab.json with merges.txt".format(" or ".join(tokenizer_sentencepiece.FILES)),
            "load it with transformers and save it again, or give its folder by --backbone",
            Code.IO,
        )
    notes.append("tokenizer: from {}, as transformers makes {} of it".format(os.path.basename(pieces), JSON_FILE))
    return tokenizer_sentencepiece.read_spec(pieces, problems), config or tokenizer_sentencepiece.CONFIG


def _with_class(folder: str, config: dict) -> dict:
    """The config with the class that AutoTokenizer builds. If the folder has a model's config, this is the class of its model_type; if
    tokenizer_config.json names another class, the generic class reads the file unchanged (transformers auto/tokenization_auto.py,
    from_pretrained)."""
    path = os.path.join(folder, MODEL_FILE)
    stated = read_json(path) if os.path.isfile(path) else {}
    own = CLASSES.get(str(stated.get("model_type")))
    named = config.get("tokenizer_class") or (None if own else stated.get("tokenizer_class"))
    auto_map = config.get("auto_map")
    if own is None or (auto_map.get("AutoTokenizer") if isinstance(auto_map, dict) else auto_map) is not None:
        return dict(config, tokenizer_class=named)
    same = named is None or str(named).replace("Fast", "") == own
    return dict(config, tokenizer_class=own if same else GENERIC[0])


def _with_rows(added: List[dict], n_vocab: int) -> List[dict]:
    """Added tokens with the id NO_ROW if the embedding has no row for them, like PaliGemma's <image>. The reference fails on text with such a
    token; the runtime refuses it."""
    return [dict(token, id=token["id"] if token["id"] < n_vocab else NO_ROW) for token in added]


def _truncation_side(spec: dict, config: dict, problems: Problems) -> str:
    """The side of truncation in the tokenizer's config, else in its file (transformers tokenization_utils_tokenizers.py); LeRobot's
    tokenizer step states none. The published SmolVLM2 tokenizer truncates on the left."""
    stated = member(spec, "truncation", dict, JSON_FILE).get("direction")
    side = config.get("truncation_side", "right" if stated is None else str(stated).lower())
    if side not in ("left", "right"):
        problems.unsupported(CONFIG_FILE + ": truncation_side", "'left' or 'right'", repr(side))
    return side

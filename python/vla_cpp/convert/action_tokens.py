# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""FAST's action tokenizer as the keys `action_tokens.*` of a bundle.

Reference: lerobot policies/pi0_fast/modeling_pi0_fast.py, which reads only the tokenizer, the scale and the min_token of the published
class; transformers 5 looks for the tokenizer in a folder named after the class's parameter.
"""

from __future__ import annotations

import os
from typing import Dict, List, NamedTuple

from .ascii_bpe import check_undivided, merge_all, ranks_of
from .bundle import Key
from .errors import Code, Problems, refuse
from .files import member, read_json
from .section import Section
from .tokenizer import TokenizerPlan
from .tokenizer_byte_level import byte_symbols
from .tokenizer_parts import CONFIG_FILE, GENERIC, JSON_FILE, NAMED, check_class, to_json

PROCESSOR_FILE, TOKENIZER_FOLDER = "processor_config.json", "bpe_tokenizer"
CLASS = "UniversalActionProcessor"
DEFAULTS: Dict[str, object] = {"scale": 10, "min_token": 0, "vocab_size": 1024, "action_dim": None, "time_horizon": None, "processor_class": None}
PREFIX, REQUIRED, STOP = "Action: ", ("Action", ":"), "|"  # literals of the reference
MAX_TOKENS, MAX_COEFFICIENT = 1 << 20, 10**6


class Spoken(NamedTuple):
    """The form of actions in the language model's answer."""

    skip: int  # number of ids at the end of the language model's vocabulary that are not FAST tokens
    required: bool  # an answer must begin with the prefix


def read_action_tokens(folder: str, text: TokenizerPlan, n_vocab: int, spoken: Spoken, problems: Problems) -> List[Key]:
    """The keys `action_tokens.*` and `solver.stop_token`. `text`: the language model's tokenizer; `n_vocab`: rows of the language model's
    head. Errors: I/O, bad_bundle."""
    if not os.path.isfile(os.path.join(folder, PROCESSOR_FILE)):
        raise refuse(folder, "{} of a FAST tokenizer".format(PROCESSOR_FILE), "none", "give its folder by --action-tokenizer", Code.IO)
    processor = Section(PROCESSOR_FILE, read_json(os.path.join(folder, PROCESSOR_FILE)), DEFAULTS, problems)
    if processor.get("processor_class") != CLASS:
        processor.bad("processor_class", CLASS, hint="other classes may decode in another way", unsupported=True)
    processor.refuse_unknown([*DEFAULTS, "auto_map"])
    minimum = processor.get("min_token")
    if type(minimum) is not int or abs(minimum) > MAX_COEFFICIENT:
        processor.bad("min_token", "a whole number")
        minimum = 0
    scale = processor.number("scale", 1e-6)
    inside = os.path.join(folder, TOKENIZER_FOLDER)
    vocab = _vocabulary(inside if os.path.isdir(inside) else folder, problems)
    first = text.n_own - 1 - spoken.skip
    if not 0 <= first < n_vocab:
        problems.add("config.json: fast_skip_tokens", "less than the {} tokens of the tokenizer".format(text.n_own), str(spoken.skip))
        first = 0
    _check_rows(text, n_vocab, problems)
    ids = {token: i for i, token in enumerate(text.tokens[:n_vocab])}
    for token in (*(REQUIRED if spoken.required else ()), STOP):
        if token not in ids:
            problems.add("tokenizer: token " + repr(token), "one, which the reference looks for in every answer", "none")
    return [
        Key("action_tokens.kind", "string", "fast"),
        Key("action_tokens.vocab", "string[]", vocab),
        Key("action_tokens.min_token", "f64", float(minimum)),
        Key("action_tokens.scale", "f64", scale),
        Key("action_tokens.first_id", "u32", first),
        Key("action_tokens.prefix_ids", "u32[]", _prefix(text, ids, problems)),
        Key("action_tokens.required_ids", "u32[]", [ids.get(token, 0) for token in REQUIRED] if spoken.required else []),
        Key("solver.stop_token", "u32", ids.get(STOP, 0)),
    ]


def _check_rows(text: TokenizerPlan, n_vocab: int, problems: Problems) -> None:
    """Refuses a head with a row that has no token: the reference fails when the network outputs such an id."""
    hole = next((i for i, token in enumerate(text.tokens) if token == "<no token {}>".format(i)), len(text.tokens))
    if hole < n_vocab:
        problems.unsupported("tokenizer: id {}".format(hole), "a token for each of the {} rows of the head".format(n_vocab), "none")


def _prefix(text: TokenizerPlan, ids: Dict[str, int], problems: Problems) -> List[int]:
    kind = next(key.value for key in text.keys if key.name == "tokenizer.kind")
    if kind != "byte_fallback_bpe":
        problems.unsupported("tokenizer", "BPE with byte fallback, as PaliGemma's", str(kind))
        return []
    check_undivided(text.keys, (), (PREFIX,), problems)
    parts = merge_all(list(PREFIX.replace(" ", "\u2581")), ranks_of(text.keys))
    for part in parts:
        if part not in ids:
            problems.unsupported("tokenizer: token " + repr(part), "one, as a part of " + repr(PREFIX), "none")
    return [ids.get(part, 0) for part in parts]


def _vocabulary(folder: str, problems: Problems) -> List[str]:
    """The texts of FAST's tokens by id, in the byte-level alphabet; empty for an id without a token."""
    spec, config = (read_json(os.path.join(folder, name)) for name in (JSON_FILE, CONFIG_FILE))
    where = "action tokenizer: " + JSON_FILE
    model = member(spec, "model", dict, where)
    for key, found, wanted in (("model", model.get("type", "BPE"), "BPE"), ("decoder", (spec.get("decoder") or {}).get("type"), "ByteLevel")):
        if found != wanted:
            problems.unsupported("{}: {}.type".format(where, key), wanted, repr(found))
    if spec.get("added_tokens"):
        problems.unsupported(where + ": added_tokens", "none", to_json(spec["added_tokens"])[:80])
    check_class(config, GENERIC, problems)
    for key in [*NAMED, "added_tokens_decoder", "clean_up_tokenization_spaces"]:
        if config.get(key):
            problems.unsupported("action tokenizer: {}: {}".format(CONFIG_FILE, key), "none", to_json(config[key])[:80])
    vocab = member(model, "vocab", dict, where)
    sound = all(type(i) is int and 0 <= i < MAX_TOKENS for i in vocab.values()) and len(set(vocab.values())) == len(vocab)
    if not vocab or not sound:
        problems.add(where + ": model.vocab", "tokens with ids of their own", "{} tokens".format(len(vocab)))
        return [""]
    by_id, symbols = {i: token for token, i in vocab.items()}, byte_symbols()
    for token in vocab:
        if token != token.encode("utf-8", "replace").decode():
            problems.add(where + ": model.vocab", "UTF-8 text", ascii(token)[:80])
    return [_spelt(by_id.get(i, ""), symbols) for i in range(max(by_id) + 1)]


def _spelt(token: str, symbols: List[str]) -> str:
    """The token in the byte-level alphabet. Training leaves tokens in the vocabulary with characters outside this alphabet; the decoder
    copies these tokens literally, so their UTF-8 bytes are encoded here."""
    return token if set(token) <= set(symbols) else "".join(symbols[byte] for byte in token.encode("utf-8", "replace"))

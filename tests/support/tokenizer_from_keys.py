# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The tokenizer that a reader of docs/bundle.md builds from a bundle's keys alone, by the library `tokenizers`."""

import json

from tokenizers import AddedToken, Regex, Tokenizer, models, normalizers, pre_tokenizers


def _pre(step):
    if step["type"] == "digits":
        return pre_tokenizers.Digits(individual_digits=step["individual"])
    if step["type"] == "byte_level":
        return pre_tokenizers.ByteLevel(add_prefix_space=step["add_prefix_space"], use_regex=step["use_regex"])
    return pre_tokenizers.Split(Regex(step["pattern"]), "isolated")


def _model(keys, vocab):
    kind = keys["tokenizer.kind"]
    if kind == "wordpiece":
        return models.WordPiece(vocab, unk_token=keys["tokenizer.tokens"][keys["tokenizer.unknown_id"]], max_input_chars_per_word=100)
    merges = [tuple(merge.split(" ")) for merge in keys["tokenizer.merges"]]
    if kind == "byte_fallback_bpe":
        return models.BPE(vocab=vocab, merges=merges, byte_fallback=True)
    return models.BPE(vocab=vocab, merges=merges, ignore_merges=bool(keys["tokenizer.ignore_merges"]))


def tokenizer_of(keys):
    vocab = {text: i for i, text in enumerate(keys["tokenizer.tokens"])}
    tokenizer = Tokenizer(_model(keys, vocab))
    normalization = keys.get("tokenizer.normalization")
    if keys["tokenizer.kind"] == "wordpiece":
        tokenizer.normalizer = normalizers.BertNormalizer(lowercase=True)
        tokenizer.pre_tokenizer = pre_tokenizers.BertPreTokenizer()
    elif keys["tokenizer.kind"] == "byte_fallback_bpe":
        first = [normalizers.Prepend("\u2581")] if normalization == "blank_first" else []
        tokenizer.normalizer = normalizers.Sequence([*first, normalizers.Replace(" ", "\u2581")])
    else:
        tokenizer.pre_tokenizer = pre_tokenizers.Sequence([_pre(step) for step in json.loads(keys["tokenizer.pre"])])
        if normalization == "nfc":
            tokenizer.normalizer = normalizers.NFC()
    for token in json.loads(keys["tokenizer.added"]):
        flags = {flag: token[flag] for flag in ("single_word", "lstrip", "rstrip", "normalized", "special")}
        (tokenizer.add_special_tokens if token["special"] else tokenizer.add_tokens)([AddedToken(token["content"], **flags)])
    return tokenizer


def ids_of(tokenizer, keys, text):
    """Added tokens have the ids of the keys, whatever the library numbers them."""
    encoding = tokenizer.encode(text, add_special_tokens=False)
    number = {token["content"]: token["id"] for token in json.loads(keys["tokenizer.added"])}
    ids = [number.get(piece, i) for piece, i in zip(encoding.tokens, encoding.ids, strict=True)]
    return [*keys.get("tokenizer.prefix_ids", []), *ids, *keys.get("tokenizer.suffix_ids", [])]

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The tokenizer.* keys of a bundle (docs/bundle.md) from a tokenizer of the `tokenizers` package, for the scripts here."""

import json


def keys_of(tokenizer) -> dict:
    spec = json.loads(tokenizer.to_str())
    model, pre = spec["model"], spec["pre_tokenizer"]
    assert spec["normalizer"] is None and model["type"] == "BPE"
    steps = pre["pretokenizers"] if pre["type"] == "Sequence" else [pre]
    tokens = {id: text for text, id in model["vocab"].items()}
    tokens.update({token["id"]: token["content"] for token in spec["added_tokens"]})
    assert sorted(tokens) == list(range(len(tokens)))
    return {
        "tokenizer.kind": "byte_level_bpe",
        "tokenizer.tokens": [tokens[i] for i in range(len(tokens))],
        "tokenizer.merges": [merge if isinstance(merge, str) else " ".join(merge) for merge in model["merges"]],
        "tokenizer.pre": json.dumps([step_of(step) for step in steps]),
        "tokenizer.added": json.dumps(spec["added_tokens"]),
        "tokenizer.ignore_merges": model["ignore_merges"],
    }


def step_of(step: dict) -> dict:
    if step["type"] == "Digits":
        return {"type": "digits", "individual": step["individual_digits"]}
    assert step["type"] == "ByteLevel"
    return {"type": "byte_level", "add_prefix_space": step["add_prefix_space"], "use_regex": step["use_regex"]}

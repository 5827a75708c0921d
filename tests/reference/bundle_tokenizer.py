# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The tokenizer.* keys of a bundle (docs/bundle.md) from a tokenizer of the `tokenizers` package, for the scripts here."""

import json

ORDER = ["tokenizer." + name for name in ("kind", "tokens", "merges", "pre", "normalization", "added", "ignore_merges", "prefix_ids", "suffix_ids", "unknown_id")]


def keys_of(tokenizer) -> dict:
    spec = json.loads(tokenizer.to_str())
    model = spec["model"]
    tokens = {id: text for text, id in model["vocab"].items()}
    tokens.update({token["id"]: token["content"] for token in spec["added_tokens"]})
    assert sorted(tokens) == list(range(len(tokens)))
    common = {
        "tokenizer.tokens": [tokens[i] for i in range(len(tokens))],
        "tokenizer.added": json.dumps(spec["added_tokens"]),
    }
    if model["type"] == "WordPiece":
        keys = {**common, **wordpiece(spec)}
    else:
        common["tokenizer.merges"] = [merge if isinstance(merge, str) else " ".join(merge) for merge in model["merges"]]
        keys = {**common, **(byte_fallback(spec) if model["byte_fallback"] else byte_level(spec))}
    return {key: keys[key] for key in ORDER if key in keys}


def byte_level(spec: dict) -> dict:
    pre = spec["pre_tokenizer"]
    steps = pre["pretokenizers"] if pre["type"] == "Sequence" else [pre]
    assert spec["normalizer"] in (None, {"type": "NFC"})
    normalization = {"tokenizer.normalization": "nfc"} if spec["normalizer"] else {}
    posts = (spec["post_processor"] or {}).get("processors", [spec["post_processor"]])
    front = [ids for post in posts if post and post["type"] == "TemplateProcessing" for ids in prefix(post)]
    roberta = [post for post in posts if post and post["type"] == "RobertaProcessing"]
    front, behind = front + [post["cls"][1] for post in roberta], [post["sep"][1] for post in roberta]
    return {
        **normalization,
        **({"tokenizer.prefix_ids": front} if front else {}),
        **({"tokenizer.suffix_ids": behind} if behind else {}),
        "tokenizer.kind": "byte_level_bpe",
        "tokenizer.pre": json.dumps([step_of(step) for step in steps]),
        "tokenizer.ignore_merges": spec["model"]["ignore_merges"],
    }


def byte_fallback(spec: dict) -> dict:
    """The blank that the pre-tokenizer splits at is gone by then: the normalizer has replaced it."""
    assert spec["normalizer"] == {"type": "Replace", "pattern": {"String": " "}, "content": "\u2581"}
    assert spec["pre_tokenizer"] is None or spec["pre_tokenizer"]["pattern"] == {"String": " "}
    front = [] if spec["post_processor"] is None else prefix(spec["post_processor"])
    return {"tokenizer.kind": "byte_fallback_bpe", "tokenizer.prefix_ids": front}


def wordpiece(spec: dict) -> dict:
    model, template = spec["model"], spec["post_processor"]
    assert (model["continuing_subword_prefix"], model["max_input_chars_per_word"]) == ("##", 100)
    assert spec["normalizer"] == dict(type="BertNormalizer", clean_text=True, handle_chinese_chars=True, strip_accents=None, lowercase=True)
    at = template["single"].index({"Sequence": {"id": "A", "type_id": 0}})
    front, behind = (prefix(dict(template, single=parts)) for parts in (template["single"][:at], template["single"][at:]))
    unknown = model["vocab"][model["unk_token"]]
    return {"tokenizer.kind": "wordpiece", "tokenizer.normalization": "bert_uncased", "tokenizer.unknown_id": unknown,
            "tokenizer.prefix_ids": front, "tokenizer.suffix_ids": behind}


def prefix(template: dict) -> list:
    special = template["special_tokens"]
    return [id for part in template["single"] if "SpecialToken" in part for id in special[part["SpecialToken"]["id"]]["ids"]]


def step_of(step: dict) -> dict:
    if step["type"] == "Digits":
        return {"type": "digits", "individual": step["individual_digits"]}
    if step["type"] == "Split":
        assert step["behavior"] == "Isolated" and not step["invert"]
        return {"type": "split", "pattern": step["pattern"]["Regex"]}
    assert step["type"] == "ByteLevel"
    return {"type": "byte_level", "add_prefix_space": step["add_prefix_space"], "use_regex": step["use_regex"]}

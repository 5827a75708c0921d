# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""tokenizer.json as the keys of a bundle, after checking that it is the byte-level BPE that the runtime implements.

Which pre-tokenizer counts follows the class that transformers 5.4 to 5.5 builds for `tokenizer_class`: the generic classes keep
tokenizer.json as it is, GPT2Tokenizer takes vocabulary and merges from it and brings a ByteLevel pre-tokenizer of its own.
"""

from __future__ import annotations

import json
import os
from typing import Dict, List, NamedTuple, Optional, Tuple

from .bundle import Key
from .errors import Code, Problems, refuse
from .files import member, read_json

JSON_FILE, CONFIG_FILE = "tokenizer.json", "tokenizer_config.json"
GENERIC = ("TokenizersBackend", "PreTrainedTokenizerFast", "PreTrainedTokenizer")
GPT2 = ("GPT2Tokenizer", "GPT2TokenizerFast")
FLAGS = ("single_word", "lstrip", "rstrip", "normalized", "special")
NAMED = (
    "bos_token",
    "eos_token",
    "unk_token",
    "sep_token",
    "pad_token",
    "cls_token",
    "mask_token",
    "additional_special_tokens",
    "extra_special_tokens",
    "image_token",
    "fake_image_token",
    "global_image_token",
    "end_of_utterance_token",
    "video_token",
)


def byte_symbols() -> List[str]:
    """The 256 printable characters that stand for bytes in byte-level vocabularies (as GPT-2 defined them)."""
    kept = [*range(ord("!"), ord("~") + 1), *range(0xA1, 0xAC + 1), *range(0xAE, 0xFF + 1)]
    moved = {byte: 256 + i for i, byte in enumerate(b for b in range(256) if b not in kept)}
    return [chr(moved.get(byte, byte)) for byte in range(256)]


class TokenizerPlan(NamedTuple):
    keys: List[Key]  # the bundle's `tokenizer.*`
    truncate: str  # the side on which a text that is too long loses tokens: left or right


def read_tokenizer(folder: str, n_vocab: int, problems: Problems, notes: List[str]) -> TokenizerPlan:
    """`n_vocab`: rows of the embedding table, which no id may reach."""
    if not os.path.exists(os.path.join(folder, JSON_FILE)):
        raise refuse(
            os.path.join(folder, JSON_FILE),
            "the tokenizer in one file",
            "none",
            "load it with transformers and save it again, or give its folder by --backbone",
            Code.IO,
        )
    spec = read_json(os.path.join(folder, JSON_FILE))
    config_path = os.path.join(folder, CONFIG_FILE)
    config = read_json(config_path) if os.path.exists(config_path) else {}
    gpt2 = config.get("tokenizer_class") in GPT2
    if gpt2:  # the class's own defaults, which it adds to the vocabulary like stated ones
        config = dict(dict.fromkeys(("unk_token", "bos_token", "eos_token"), "<|endoftext|>"), **config)
    model = member(spec, "model", dict, JSON_FILE)
    _check_model(model, problems)
    _check_surroundings(spec, config, problems)
    added = _added_tokens(spec, problems)
    _check_config_tokens(config, added, problems)
    pre = _pre_tokenizer(spec.get("pre_tokenizer"), problems)
    if gpt2:
        own = [
            {"type": "byte_level", "add_prefix_space": bool(config.get("add_prefix_space", False)), "use_regex": True}
        ]
        if pre != own:
            notes.append(
                "{} names {}: transformers 5 then replaces the pre-tokenizer of {} by a plain ByteLevel, and so does the bundle".format(
                    CONFIG_FILE, config["tokenizer_class"], JSON_FILE
                )
            )
        pre = own
    tokens, merges = _vocabulary(model, added, n_vocab, problems)
    keys = [
        Key("tokenizer.kind", "string", "byte_level_bpe"),
        Key("tokenizer.tokens", "string[]", tokens),
        Key("tokenizer.merges", "string[]", merges),
        Key("tokenizer.pre", "string", _json(pre)),
        Key("tokenizer.added", "string", _json(added)),
        Key("tokenizer.ignore_merges", "bool", bool(model.get("ignore_merges", False)) and not gpt2),
    ]
    return TokenizerPlan(keys, _truncation_side(spec, config, problems))


def _truncation_side(spec: dict, config: dict, problems: Problems) -> str:
    """LeRobot's tokenizer step does not state a side, so the tokenizer's own holds: that of its config, else that of its file
    (transformers tokenization_utils_tokenizers.py). The published SmolVLM2 tokenizer says left."""
    stated = member(spec, "truncation", dict, JSON_FILE).get("direction")
    side = config.get("truncation_side", "right" if stated is None else str(stated).lower())
    if side not in ("left", "right"):
        problems.unsupported(CONFIG_FILE + ": truncation_side", "'left' or 'right'", repr(side))
    return side


def _json(value) -> str:
    return json.dumps(value, ensure_ascii=False, separators=(",", ":"))


def _check_model(model: dict, problems: Problems) -> None:
    """The unknown token needs no check: with all 256 byte symbols in the vocabulary no text can reach it."""
    allowed = {
        "type": ("BPE",),
        "dropout": (None, 0, 0.0),
        "continuing_subword_prefix": (None, ""),
        "end_of_word_suffix": (None, ""),
        "byte_fallback": (False, None),
    }
    for key, values in allowed.items():
        found = model.get(key, "BPE" if key == "type" and "merges" in model else None)
        if found not in values:
            problems.unsupported(
                "{}: model.{}".format(JSON_FILE, key),
                repr(values[0]),
                repr(found),
                "the runtime implements byte-level BPE only",
            )


def _check_surroundings(spec: dict, config: dict, problems: Problems) -> None:
    normalizer = spec.get("normalizer")
    if normalizer is not None and normalizer != {"type": "Sequence", "normalizers": []}:
        problems.unsupported(
            JSON_FILE + ": normalizer", "none", _json(normalizer)[:80], "the runtime does not normalise text"
        )
    if not _adds_nothing(spec.get("post_processor")):
        problems.unsupported(
            JSON_FILE + ": post_processor",
            "none, ByteLevel, or a template of the text alone",
            _json(spec["post_processor"])[:80],
        )
    name = config.get("tokenizer_class")
    if name is not None and name not in GENERIC + GPT2:
        problems.unsupported(
            CONFIG_FILE + ": tokenizer_class",
            " or ".join(GENERIC + GPT2),
            str(name),
            "other classes build a tokenizer of their own around the same file",
        )
    for key, value in (("split_special_tokens", False), ("add_bos_token", False), ("add_eos_token", False)):
        if config.get(key, value) not in (value, None):
            problems.unsupported("{}: {}".format(CONFIG_FILE, key), repr(value), repr(config[key]))


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
    parts = (
        member(pre, "pretokenizers", list, JSON_FILE)
        if isinstance(pre, dict) and pre.get("type") == "Sequence"
        else [pre]
    )
    steps = []
    for part in parts:
        kind = part.get("type") if isinstance(part, dict) else None
        if kind == "Digits" and set(part) <= {"type", "individual_digits"}:
            steps.append({"type": "digits", "individual": bool(part.get("individual_digits", False))})
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
                "Digits and ByteLevel",
                _json(part)[:80],
                "the runtime implements these two",
            )
            return []
    if [step["type"] for step in steps].count("byte_level") != 1 or steps[-1]["type"] != "byte_level":
        problems.unsupported(JSON_FILE + ": pre_tokenizer", "ByteLevel once, as the last step", _json(pre)[:80])
    return steps


def _added_tokens(spec: dict, problems: Problems) -> List[dict]:
    added = []
    for token in member(spec, "added_tokens", list, JSON_FILE):
        content, number = (token.get("content"), token.get("id")) if isinstance(token, dict) else (None, None)
        if not isinstance(content, str) or not content or not isinstance(number, int) or isinstance(number, bool):
            problems.add(JSON_FILE + ": added_tokens", "tokens with id and content", _json(token)[:80])
            continue
        added.append({"id": number, "content": content, **{flag: bool(token.get(flag, False)) for flag in FLAGS}})
    return added


def _content(token) -> Optional[str]:
    return token.get("content") if isinstance(token, dict) else token


def _check_config_tokens(config: dict, added: List[dict], problems: Problems) -> None:
    """transformers adds every token that the config names and tokenizer.json lacks: text would then split differently."""
    by_content = {token["content"]: token for token in added}
    for key in NAMED:
        value = config.get(key)
        values = (
            list(value.values())
            if isinstance(value, dict) and "content" not in value
            else value
            if isinstance(value, list)
            else [value]
        )
        for token in (_content(v) for v in values if v is not None):
            if not isinstance(token, str) or token not in by_content:
                problems.add(
                    "{}: {}".format(CONFIG_FILE, key),
                    "a token among the added tokens of " + JSON_FILE,
                    repr(token),
                    "load the tokenizer with transformers and save it again",
                )
    for number, token in member(config, "added_tokens_decoder", dict, CONFIG_FILE).items():
        content = _content(token)
        own = by_content.get(content) if isinstance(content, str) else None
        stated = {flag: bool(token.get(flag, False)) for flag in FLAGS} if isinstance(token, dict) else {}
        if own is None or str(own["id"]) != number or any(own[flag] != value for flag, value in stated.items()):
            problems.add(
                "{}: added_tokens_decoder.{}".format(CONFIG_FILE, number),
                "the token as {} has it".format(JSON_FILE),
                _json(token)[:120],
                "load the tokenizer with transformers and save it again",
            )


def _vocabulary(model: dict, added: List[dict], n_vocab: int, problems: Problems) -> Tuple[List[str], List[str]]:
    vocab = model.get("vocab")
    if (
        not isinstance(vocab, dict)
        or not vocab
        or not all(isinstance(i, int) and not isinstance(i, bool) and i >= 0 for i in vocab.values())
    ):
        raise refuse(JSON_FILE + ": model.vocab", "tokens with ids", str(type(vocab).__name__))
    by_id: Dict[int, str] = {}
    for text, number in [*vocab.items(), *((token["content"], token["id"]) for token in added)]:
        if by_id.setdefault(number, text) != text or vocab.get(text, number) != number:
            problems.add(
                "{}: id {}".format(JSON_FILE, number), "one token", "{!r} and {!r}".format(by_id[number], text)
            )
    _check_symbols(vocab, by_id, n_vocab, problems)
    # A hole gets a text that no merge and no word can produce: byte-level symbols contain no blank.
    tokens = [by_id.get(number, "<no token {}>".format(number)) for number in range(min(max(by_id) + 1, n_vocab))]
    return tokens, _merges(model.get("merges"), vocab, problems)


def _check_symbols(vocab: Dict[str, int], by_id: Dict[int, str], n_vocab: int, problems: Problems) -> None:
    missing = [symbol for symbol in byte_symbols() if symbol not in vocab]
    if missing:
        problems.add(
            JSON_FILE + ": model.vocab",
            "all 256 byte symbols",
            "{} missing, the first is {!r}".format(len(missing), missing[0]),
        )
    above = sorted(number for number in by_id if number >= n_vocab)
    if above:
        problems.add(
            JSON_FILE + ": ids",
            "ids below vocab_size {}".format(n_vocab),
            "{} above, the first is {} ({!r})".format(len(above), above[0], by_id[above[0]]),
            "the tokenizer belongs to another backbone: check --backbone",
        )
    for text in by_id.values():
        try:
            text.encode("utf-8")
        except UnicodeEncodeError:
            problems.add(JSON_FILE + ": model.vocab", "UTF-8 text", ascii(text)[:80])


def _merges(merges, vocab: Dict[str, int], problems: Problems) -> List[str]:
    """Merges in rank order as "left right", from either spelling of the file."""
    result = []
    for rank, merge in enumerate(merges if isinstance(merges, list) else []):
        pair = merge.split(" ") if isinstance(merge, str) else merge
        valid = (
            isinstance(pair, list)
            and len(pair) == 2
            and all(isinstance(part, str) and part in vocab and " " not in part for part in pair)
        )
        if not valid or pair[0] + pair[1] not in vocab:
            problems.add(
                "{}: model.merges[{}]".format(JSON_FILE, rank), "two tokens whose union is a token", _json(merge)[:80]
            )
            return result
        result.append(" ".join(pair))
    if not isinstance(merges, list):
        problems.add(JSON_FILE + ": model.merges", "a list", type(merges).__name__)
    return result

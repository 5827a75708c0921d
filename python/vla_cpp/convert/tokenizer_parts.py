# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Parts of a tokenizer.json that all kinds of tokenizers share: vocabulary, merges, added tokens, and their checks."""

from __future__ import annotations

import json
from typing import Dict, Iterable, List, NamedTuple, Optional, Sequence, Tuple

from .errors import Problems, refuse
from .files import member

JSON_FILE, CONFIG_FILE = "tokenizer.json", "tokenizer_config.json"
GENERIC = ("TokenizersBackend", "PreTrainedTokenizerFast", "PreTrainedTokenizer")
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


class Tokenizer(NamedTuple):
    """The contents of the tokenizer's files, before any check."""

    spec: dict  # tokenizer.json
    config: dict  # tokenizer_config.json with the defaults of its class
    model: dict  # the member `model` of spec
    added: List[dict]  # added tokens in the form that a bundle stores
    n_vocab: int


def check_model(model: dict, allowed: Dict[str, tuple], what: str, problems: Problems) -> None:
    for key, values in allowed.items():
        found = model.get(key, "BPE" if key == "type" and "merges" in model else None)
        if found not in values:
            problems.unsupported("{}: model.{}".format(JSON_FILE, key), repr(values[0]), repr(found), "the runtime implements " + what)


def check_class(config: dict, names: Tuple[str, ...], problems: Problems) -> None:
    name = config.get("tokenizer_class")
    if name is not None and name not in names:
        problems.unsupported(
            CONFIG_FILE + ": tokenizer_class",
            " or ".join(names),
            str(name),
            "other classes build a tokenizer of their own around the same file",
        )
    if config.get("split_special_tokens", False) not in (False, None):
        problems.unsupported(CONFIG_FILE + ": split_special_tokens", "False", repr(config["split_special_tokens"]))


def one_or_sequence(value, member_name: str) -> list:
    """The steps of a normalizer or pre-tokenizer as a list; a single step may be stored without a Sequence."""
    if isinstance(value, dict) and value.get("type") == "Sequence":
        return member(value, member_name, list, JSON_FILE)
    return [] if value is None else [value]


def to_json(value) -> str:
    return json.dumps(value, ensure_ascii=False, separators=(",", ":"))


def added_tokens(spec: dict, model: dict, config: dict, problems: Problems, notes: List[str]) -> List[dict]:
    """The added tokens, with the ids that the tokenizers library assigns, which may differ from the file's: a token of the model keeps the
    model's id, any other gets the next free one (tokenizers added_vocabulary.rs, add_tokens). A class that builds its own tokenizer adds
    them in the order of the file's ids."""
    vocab, added, renumbered = member(model, "vocab", dict, JSON_FILE), [], []
    listed = member(spec, "added_tokens", list, JSON_FILE)
    if config.get("tokenizer_class") not in (None, *GENERIC):
        listed = sorted(listed, key=lambda token: token["id"] if isinstance(token, dict) and type(token.get("id")) is int else 0)
    for token in listed:
        content, number = (token.get("content"), token.get("id")) if isinstance(token, dict) else (None, None)
        if not isinstance(content, str) or not content or type(number) is not int or number < 0:
            problems.add(JSON_FILE + ": added_tokens", "tokens with id and content", to_json(token)[:80])
            continue
        if any(not isinstance(token.get(flag), bool) for flag in FLAGS):
            problems.add(JSON_FILE + ": added_tokens", "tokens with true or false for " + ", ".join(FLAGS), to_json(token)[:120])
        there = next((other for other in added if other["content"] == content), None)
        own = there["id"] if there else vocab.get(content, next_id(added, vocab))
        if own != number:
            renumbered.append("{} is {}".format(content, own))
        flags = {flag: bool(token.get(flag, False)) for flag in FLAGS}
        if there:
            there.update(flags)
        else:
            added.append({"id": own, "content": content, **flags})
    if renumbered:
        told = ", ".join(renumbered[:3]) + (", ..." if len(renumbered) > 3 else "")
        notes.append("{}: added tokens have other ids than the file states, as transformers numbers them: {}".format(JSON_FILE, told))
    return added


def next_id(added: List[dict], vocab: dict) -> int:
    return max([len(vocab), *(token["id"] + 1 for token in added)])


def add_special(added: List[dict], model: dict, texts: Sequence[str], problems: Problems) -> None:
    """Adds special tokens to `added` as transformers does: an existing one stays unchanged, a new one gets the next id (tokenizers
    added_vocabulary.rs, add_tokens)."""
    vocab = member(model, "vocab", dict, JSON_FILE) if texts else {}
    there = {token["content"] for token in added}
    for text in (text for text in texts if text not in there):
        if text in vocab:
            problems.unsupported(JSON_FILE + ": model.vocab", "no token " + text + " of the model's", "one", "text would split around it")
        added.append({"id": next_id(added, vocab), "content": text, **dict.fromkeys(FLAGS, False), "special": True})
        there.add(text)


def content_of(token) -> Optional[str]:
    return token.get("content") if isinstance(token, dict) else token


def check_config_tokens(config: dict, added: List[dict], problems: Problems) -> None:
    """Checks that tokenizer.json has every token that the config names: transformers would add a missing one, and text would split
    differently."""
    by_content = {token["content"]: token for token in added}
    for key in NAMED:
        value = config.get(key)
        values = (
            list(value.values()) if isinstance(value, dict) and "content" not in value else value if isinstance(value, list) else [value]
        )
        for token in (content_of(v) for v in values if v is not None):
            if not isinstance(token, str) or token not in by_content:
                problems.add(
                    "{}: {}".format(CONFIG_FILE, key),
                    "a token among the added tokens of " + JSON_FILE,
                    repr(token),
                    "load the tokenizer with transformers and save it again",
                )
    decoder = member(config, "added_tokens_decoder", dict, CONFIG_FILE)
    listed = {content_of(token) for token in decoder.values()}
    missing = [token["content"] for token in added if token["content"] not in listed]
    if decoder and missing and config.get("tokenizer_class") not in (None, *GENERIC):
        problems.add(
            CONFIG_FILE + ": added_tokens_decoder",
            "all added tokens of {}, since {} takes no others".format(JSON_FILE, config["tokenizer_class"]),
            "{} missing, the first is {!r}".format(len(missing), missing[0]),
            "load the tokenizer with transformers and save it again",
        )
    for number, token in decoder.items():
        content = content_of(token)
        own = by_content.get(content) if isinstance(content, str) else None
        stated = {flag: bool(token.get(flag, False)) for flag in FLAGS} if isinstance(token, dict) else {}
        if own is None or str(own["id"]) != number or any(own[flag] != value for flag, value in stated.items()):
            problems.add(
                "{}: added_tokens_decoder.{}".format(CONFIG_FILE, number),
                "the token as {} has it".format(JSON_FILE),
                to_json(token)[:120],
                "load the tokenizer with transformers and save it again",
            )


def vocabulary(tokenizer: Tokenizer, problems: Problems) -> List[str]:
    """Texts of the tokens, by id."""
    vocab = tokenizer.model.get("vocab")
    if (
        not isinstance(vocab, dict)
        or not vocab
        or not all(isinstance(i, int) and not isinstance(i, bool) and i >= 0 for i in vocab.values())
    ):
        raise refuse(JSON_FILE + ": model.vocab", "tokens with ids", str(type(vocab).__name__))
    by_id: Dict[int, str] = {}
    for text, number in [*vocab.items(), *((token["content"], token["id"]) for token in tokenizer.added)]:
        if by_id.setdefault(number, text) != text or vocab.get(text, number) != number:
            problems.add("{}: id {}".format(JSON_FILE, number), "one token", "{!r} and {!r}".format(by_id[number], text))
    check_ids(vocab, tokenizer.n_vocab, problems)
    _check_utf8(by_id.values(), problems)
    # An id without a token gets a text that no merge and no word can produce, since symbols contain no blank.
    last = max((number for number in by_id if number < tokenizer.n_vocab), default=-1)
    return [by_id.get(number, "<no token {}>".format(number)) for number in range(last + 1)]


def check_symbols(model: dict, symbols: List[str], problems: Problems) -> None:
    """Checks that the vocabulary has a symbol for each of the 256 bytes, so that no text needs the unknown token."""
    vocab = member(model, "vocab", dict, JSON_FILE)
    missing = [symbol for symbol in symbols if symbol not in vocab]
    if missing:
        problems.add(JSON_FILE + ": model.vocab", "all 256 byte symbols", "{} missing, the first is {!r}".format(len(missing), missing[0]))


def check_ids(ids: Dict[str, int], n_vocab: int, problems: Problems) -> None:
    above = sorted((number, text) for text, number in ids.items() if number >= n_vocab)
    if above:
        problems.add(
            JSON_FILE + ": ids",
            "ids below vocab_size {}".format(n_vocab),
            "{} above, the first is {} ({!r})".format(len(above), *above[0]),
            "the tokenizer belongs to another backbone: check --backbone",
        )


def _check_utf8(texts: Iterable[str], problems: Problems) -> None:
    for text in texts:
        try:
            text.encode("utf-8")
        except UnicodeEncodeError:
            problems.add(JSON_FILE + ": model.vocab", "UTF-8 text", ascii(text)[:80])


def merges_of(merges, vocab: Dict[str, int], problems: Problems) -> List[str]:
    """Merges in rank order as "left right"; the file may store each as one text or as a pair."""
    result = []
    for rank, merge in enumerate(merges if isinstance(merges, list) else []):
        pair = merge.split(" ") if isinstance(merge, str) else merge
        valid = (
            isinstance(pair, list) and len(pair) == 2 and all(isinstance(part, str) and part in vocab and " " not in part for part in pair)
        )
        if not valid or pair[0] + pair[1] not in vocab:
            problems.add("{}: model.merges[{}]".format(JSON_FILE, rank), "two tokens whose union is a token", to_json(merge)[:80])
            return result
        result.append(" ".join(pair))
    if not isinstance(merges, list):
        problems.add(JSON_FILE + ": model.merges", "a list", type(merges).__name__)
    return result


def prefix_ids(tokenizer: Tokenizer, problems: Problems) -> List[int]:
    """The ids before every text, for a template without ids after the text."""
    return stated_around(tokenizer, problems, "a template of special tokens and then the text", may_follow=False)[0]


def stated_around(tokenizer: Tokenizer, problems: Problems, wanted: str, may_follow: bool) -> Tuple[List[int], List[int]]:
    """The ids before and after every text, from the file's template. transformers 5.5 keeps this template regardless of add_bos_token and
    add_eos_token in the config; a config that contradicts the template is refused, since it may be meant for another release."""
    config = tokenizer.config
    front, behind = around_ids(tokenizer, problems, wanted, may_follow)
    if config.get("add_eos_token", False) not in (False, None):
        problems.unsupported(CONFIG_FILE + ": add_eos_token", "False", repr(config["add_eos_token"]))
    if config.get("add_bos_token") is not None and bool(config["add_bos_token"]) != bool(front):
        problems.add(
            CONFIG_FILE + ": add_bos_token",
            "{}, as the template of {} has it".format(bool(front), JSON_FILE),
            repr(config["add_bos_token"]),
            "load the tokenizer with transformers and save it again",
        )
    return front, behind


def class_around(tokenizer: Tokenizer, stated: Tuple[List[int], List[int]], problems: Problems, notes: List[str]) -> Tuple[List[int], List[int]]:
    """The ids before and after a text, for a class that builds the template itself from cls_token and sep_token of the config. `stated`: the
    ids in the file's template, which must be the same."""
    ids = {**member(tokenizer.model, "vocab", dict, JSON_FILE), **{token["content"]: token["id"] for token in tokenizer.added}}
    names = [content_of(tokenizer.config.get(name)) for name in ("cls_token", "sep_token")]
    own = tuple([ids.get(name, -1)] for name in names if isinstance(name, str))
    if len(own) != 2 or [-1] in own:
        problems.add(CONFIG_FILE + ": cls_token, sep_token", "two tokens of " + JSON_FILE, repr(names))
        return stated
    if tokenizer.spec.get("post_processor") is None:
        told = "{}: no post_processor; {} builds one of {} and {}, and so does the bundle"
        notes.append(told.format(JSON_FILE, tokenizer.config["tokenizer_class"], *names))
    elif own != stated:
        problems.add(JSON_FILE + ": post_processor", "{} and {} of {}: {}".format(*names, CONFIG_FILE, own), str(stated))
    return own


def around_ids(tokenizer: Tokenizer, problems: Problems, wanted: str, may_follow: bool) -> Tuple[List[int], List[int]]:
    """The ids before and after every text in the file's template. `wanted`: describes the supported templates in an error."""
    # ByteLevel only trims offsets.
    posts = [post for post in one_or_sequence(tokenizer.spec.get("post_processor"), "processors") if not _is_byte_level(post)]
    if not posts:
        return [], []
    post = _template(posts[0]) if len(posts) == 1 else None
    single = post.get("single") if isinstance(post, dict) else None
    parts = single if isinstance(single, list) and post.get("type") == "TemplateProcessing" else []
    kinds = [next(iter(part), None) if isinstance(part, dict) else None for part in parts]
    at = kinds.index("Sequence") if "Sequence" in kinds else -1
    others = kinds[:at] + kinds[at + 1 :]
    if at < 0 or others != ["SpecialToken"] * len(others) or (at < len(others) and not may_follow):
        problems.unsupported(JSON_FILE + ": post_processor", wanted, to_json(tokenizer.spec["post_processor"])[:120])
        return [], []
    special = member(post, "special_tokens", dict, JSON_FILE)
    return _ids_of(parts[:at], special, tokenizer, problems), _ids_of(parts[at + 1 :], special, tokenizer, problems)


def _template(post):
    """RoBERTa's post-processing step, which BART's files have, as the equivalent template: cls, text, sep. Its other fields only trim
    offsets."""
    if not isinstance(post, dict) or post.get("type") != "RobertaProcessing":
        return post
    known = {"type", "sep", "cls", "trim_offsets", "add_prefix_space"}
    pairs = {name: post.get(name) for name in ("cls", "sep")}
    if set(post) - known or not all(isinstance(p, list) and len(p) == 2 and isinstance(p[0], str) for p in pairs.values()):
        return None
    special = {name: {"id": name, "ids": [number], "tokens": [name]} for name, number in pairs.values()}
    single = [{"SpecialToken": {"id": pairs["cls"][0]}}, {"Sequence": {"id": "A"}}, {"SpecialToken": {"id": pairs["sep"][0]}}]
    return {"type": "TemplateProcessing", "single": single, "special_tokens": special}


def _ids_of(parts: List[dict], special: dict, tokenizer: Tokenizer, problems: Problems) -> List[int]:
    ids: List[int] = []
    for part in parts:
        name = member(part, "SpecialToken", dict, JSON_FILE).get("id")
        ids += member(member(special, name, dict, JSON_FILE) if isinstance(name, str) else {}, "ids", list, JSON_FILE)
    if len(ids) < len(parts) or not all(isinstance(i, int) and 0 <= i < tokenizer.n_vocab for i in ids):
        problems.add(JSON_FILE + ": post_processor.special_tokens", "an id below {} for each token".format(tokenizer.n_vocab), str(ids))
    return ids


def _is_byte_level(post) -> bool:
    return isinstance(post, dict) and post.get("type") == "ByteLevel"

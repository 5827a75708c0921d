# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""vocab.json and merges.txt of Qwen2, which older repositories have instead of tokenizer.json.

Reference: transformers models/qwen2/tokenization_qwen2.py, whose class defines how text is split.
"""

from __future__ import annotations

import os
from typing import List

from .errors import Problems
from .files import member, read_json, read_text
from .tokenizer_byte_level import QWEN2, QWEN2_WORDS, SPLITS
from .tokenizer_parts import CONFIG_FILE

VOCAB_FILE, MERGES_FILE, ADDED_FILE = "vocab.json", "merges.txt", "added_tokens.json"


def present(folder: str) -> bool:
    return all(os.path.exists(os.path.join(folder, name)) for name in (VOCAB_FILE, MERGES_FILE))


def read_spec(folder: str, config: dict, problems: Problems) -> dict:
    """The equivalent tokenizer.json. Errors: io, bad_bundle; problems for another class and for tokens without flags."""
    name = config.get("tokenizer_class")
    if name not in QWEN2:
        problems.unsupported(
            CONFIG_FILE + ": tokenizer_class",
            " or ".join(QWEN2),
            str(name),
            "vocab.json and merges.txt do not say how text is split: save the tokenizer as tokenizer.json",
        )
    vocab = read_json(os.path.join(folder, VOCAB_FILE))
    return {
        "added_tokens": _added_tokens(folder, config, problems),
        "normalizer": {"type": "NFC"},
        "pre_tokenizer": {
            "type": "Sequence",
            "pretokenizers": [SPLITS[QWEN2_WORDS], {"type": "ByteLevel", "add_prefix_space": False, "use_regex": False}],
        },
        "model": {"type": "BPE", "vocab": vocab, "merges": _merges(os.path.join(folder, MERGES_FILE))},
    }


def _added_tokens(folder: str, config: dict, problems: Problems) -> List[dict]:
    """The added tokens with their flags from the config. added_tokens.json has only ids, which must agree."""
    decoder = member(config, "added_tokens_decoder", dict, CONFIG_FILE)
    added = [
        {"id": int(number), **token}
        for number, token in decoder.items()
        if number.isascii() and number.isdigit() and isinstance(token, dict)
    ]
    path = os.path.join(folder, ADDED_FILE)
    own = {token.get("content"): token["id"] for token in added if isinstance(token.get("content"), str)}
    for content, number in (read_json(path) if os.path.exists(path) else {}).items():
        if own.get(content) != number:
            problems.add(
                "{}: {}".format(ADDED_FILE, content),
                "a token that added_tokens_decoder of {} has under the same id".format(CONFIG_FILE),
                repr(number),
                "load the tokenizer with transformers and save it again",
            )
    return sorted(added, key=lambda token: token["id"])


def _merges(path: str) -> List[str]:
    lines = [line.strip() for line in read_text(path).split("\n")]
    if lines and lines[0].startswith("#version:"):
        lines = lines[1:]
    return [line for line in lines if line]

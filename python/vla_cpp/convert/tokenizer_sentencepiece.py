# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Converts a SentencePiece model, which openpi loads, to the equivalent tokenizer.json, as transformers does.

Reference: transformers convert_slow_tokenizer.py (GemmaConverter, GemmaSentencePieceExtractor, generate_merges). Both tokenize text alike
except for the name of a control token, such as <bos>, within a text: SentencePiece reads it as plain characters.
"""

from __future__ import annotations

import math
import os
from typing import Dict, List, Optional, Tuple

from .errors import Code, Problems, refuse
from .files import read_file

FILES = ("tokenizer.model", "paligemma_tokenizer.model")  # file names on the hub and in openpi's download
CONFIG = {"tokenizer_class": "GemmaTokenizer"}  # used if there is no tokenizer_config.json
BLANK = "\u2581"
BPE, NORMAL, UNKNOWN, CONTROL, USER_DEFINED, BYTE = 2, 1, 2, 3, 4, 6  # sentencepiece_model.proto
MAX_SIZE = 64 << 20


def find(folder: str) -> Optional[str]:
    """The path of the folder's SentencePiece model, if it has one."""
    return next((path for path in (os.path.join(folder, name) for name in FILES) if os.path.exists(path)), None)


def read_spec(path: str, problems: Problems) -> dict:
    """The equivalent tokenizer.json. Errors: io; bad_bundle for a file of another format; problems for settings that the runtime lacks."""
    model = _parse(path)
    name = os.path.basename(path)
    _check_settings(model, name, problems)
    vocab = {piece.piece: i for i, piece in enumerate(model.pieces)}
    if len(vocab) != len(model.pieces):
        raise refuse(name, "pieces that differ", "{} of {} texts".format(len(vocab), len(model.pieces)))
    if "\t" not in vocab and "<0x09>" in vocab:  # as in the reference's converter: the tab takes the id of <0x09> and can be merged
        vocab = {"\t" if text == "<0x09>" else text: i for text, i in vocab.items()}
    flags = {"single_word": False, "lstrip": False, "rstrip": False, "normalized": False}
    added = [
        {"id": i, "content": piece.piece, **flags, "special": piece.type != USER_DEFINED}
        for i, piece in enumerate(model.pieces)
        if piece.type in (UNKNOWN, CONTROL, USER_DEFINED)
    ]
    bos = model.trainer_spec.bos_piece
    front = [{"SpecialToken": {"id": bos, "type_id": 0}}, {"Sequence": {"id": "A", "type_id": 0}}]
    return {
        "added_tokens": added,
        "normalizer": {"type": "Replace", "pattern": {"String": " "}, "content": BLANK},
        "post_processor": {
            "type": "TemplateProcessing",
            "single": front,
            "pair": front,
            "special_tokens": {bos: {"id": bos, "ids": [vocab.get(bos, -1)], "tokens": [bos]}},
        },
        "model": {
            "type": "BPE",
            "unk_token": model.trainer_spec.unk_piece,
            "fuse_unk": True,
            "byte_fallback": True,
            "vocab": vocab,
            "merges": _merges(model, vocab),
        },
    }


def _parse(path: str):
    try:
        from google.protobuf.message import DecodeError
        from sentencepiece import sentencepiece_model_pb2
    except ImportError as error:
        raise refuse(path, "the package that reads SentencePiece models", str(error), "pip install sentencepiece", Code.UNSUPPORTED)
    model = sentencepiece_model_pb2.ModelProto()
    try:
        model.ParseFromString(read_file(path, MAX_SIZE))
        # For text that is not UTF-8, some protobuf releases return bytes and others raise an error.
        sound = all(isinstance(p.piece, str) and p.piece and math.isfinite(p.score) for p in model.pieces)
    except (DecodeError, UnicodeDecodeError) as error:
        raise refuse(path, "a SentencePiece model", str(error)[:80], "the file is damaged: download it again")
    if not sound or not model.pieces:
        raise refuse(path, "a SentencePiece model", "no pieces, or some without text or score")
    return model


def _check_settings(model, name: str, problems: Problems) -> None:
    """Refuses settings other than Gemma's, with which text is tokenized or normalized in ways that the runtime does not implement."""
    trainer, normalizer = model.trainer_spec, model.normalizer_spec
    found = {
        "trainer_spec.model_type": (trainer.model_type, BPE),
        "trainer_spec.byte_fallback": (trainer.byte_fallback, True),
        "trainer_spec.treat_whitespace_as_suffix": (trainer.treat_whitespace_as_suffix, False),
        "normalizer_spec.precompiled_charsmap": (len(normalizer.precompiled_charsmap), 0),
        "normalizer_spec.add_dummy_prefix": (normalizer.add_dummy_prefix, False),
        "normalizer_spec.remove_extra_whitespaces": (normalizer.remove_extra_whitespaces, False),
        "normalizer_spec.escape_whitespaces": (normalizer.escape_whitespaces, True),
    }
    for key, (value, wanted) in found.items():
        if value != wanted:
            problems.unsupported("{}: {}".format(name, key), "{} as in Gemma's".format(wanted), str(value), "give its tokenizer.json")
    kinds = {piece.type for piece in model.pieces} - {NORMAL, UNKNOWN, CONTROL, USER_DEFINED, BYTE}
    if kinds:
        problems.unsupported(name + ": pieces", "pieces that are all used", "pieces of type {}".format(sorted(kinds)))


def _merges(model, vocab: Dict[str, int]) -> List[List[str]]:
    """Every pair of pieces that forms a piece: by the formed piece's score, best first, then the longest left part, then the longest right
    part."""
    merges: List[Tuple[float, int, int, str, str]] = []
    for piece in model.pieces:
        if piece.type not in (NORMAL, USER_DEFINED):
            continue
        text = piece.piece
        splits = [(text[:i], text[i:]) for i in range(1, len(text))]
        pairs = sorted((vocab[a], vocab[b], a, b) for a, b in splits if a in vocab and b in vocab)
        merges += [(piece.score, len(a), len(b), a, b) for _, _, a, b in pairs]
    merges.sort(key=lambda merge: merge[:3], reverse=True)
    return [[left, right] for *_, left, right in merges]

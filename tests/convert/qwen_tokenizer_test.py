# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The keys of a tokenizer that splits text as Qwen2 does, from tokenizer.json and from vocab.json with merges.txt."""

import json

import pytest
from tokenizer_test import STRINGS, ids, reference

from tiny import N_VOCAB, SPECIAL, write_json
from vla_cpp.convert import Code
from vla_cpp.convert.errors import ConvertError, Problems
from vla_cpp.convert.tokenizer import read_tokenizer
from vla_cpp.convert.tokenizer_byte_level import QWEN2_WORDS, SPLITS

BYTES = {"type": "ByteLevel", "add_prefix_space": False, "trim_offsets": True, "use_regex": False}
STEPS = [
    {"type": "split", "pattern": QWEN2_WORDS},
    {"type": "byte_level", "add_prefix_space": False, "use_regex": False},
]
NAMED = dict.fromkeys(("unk_token", "bos_token", "eos_token", "pad_token"), SPECIAL[0])


@pytest.fixture
def qwen(tiny):
    tiny.tokenizer["normalizer"] = {"type": "NFC"}
    tiny.tokenizer["pre_tokenizer"] = {"type": "Sequence", "pretokenizers": [SPLITS[QWEN2_WORDS], BYTES]}
    return tiny


def test_the_split_and_the_normalization_of_the_file_are_kept(converter, qwen):
    keys = converter.bundle(qwen).keys
    assert json.loads(keys["tokenizer.pre"]) == STEPS and keys["tokenizer.normalization"] == "nfc"
    for text in [*STRINGS, "cafe\u0301 IT'S \u212b", "\u1100\u1161\r\n x\n"]:
        assert ids(keys, text) == reference(qwen, text).ids, text


def test_without_a_normalizer_there_is_no_key(converter, qwen):
    qwen.tokenizer["normalizer"] = None
    assert "tokenizer.normalization" not in converter.bundle(qwen).keys


def test_the_qwen2_class_brings_its_own_splitting(converter, tiny):
    tiny.tokenizer_config = {"tokenizer_class": "Qwen2Tokenizer", **NAMED}
    keys = converter.bundle(tiny).keys
    assert json.loads(keys["tokenizer.pre"]) == STEPS and keys["tokenizer.normalization"] == "nfc"
    assert any("Qwen2Tokenizer" in note for note in converter.summary.notes)


@pytest.mark.parametrize("change", [{"behavior": "Removed"}, {"invert": True}, {"pattern": {"Regex": "\\\\s+"}}])
def test_another_split_is_refused(converter, qwen, change):
    qwen.tokenizer["pre_tokenizer"]["pretokenizers"][0] = {**SPLITS[QWEN2_WORDS], **change}
    error = converter.refusal(qwen)
    assert error.code == Code.UNSUPPORTED and "expected Digits, the Split of Qwen2 or Llama 3 and ByteLevel" in error.message()


def write_vocab_files(folder, spec, **changes):
    """The files of the slow class, from a tokenizer.json."""
    added = {token["id"]: token for token in spec["added_tokens"]}
    decoder = {str(i): {key: value for key, value in token.items() if key != "id"} for i, token in added.items()}
    config = {"tokenizer_class": "Qwen2Tokenizer", "added_tokens_decoder": decoder, **NAMED, **changes}
    write_json(str(folder / "tokenizer_config.json"), config)
    write_json(str(folder / "vocab.json"), spec["model"]["vocab"])
    write_json(str(folder / "added_tokens.json"), {token["content"]: i for i, token in added.items()})
    merges = [merge if isinstance(merge, str) else " ".join(merge) for merge in spec["model"]["merges"]]
    (folder / "merges.txt").write_text("#version: 0.2\n" + "".join(merge + "\n" for merge in merges), encoding="utf-8")


def keys_of(folder):
    problems, notes = Problems("test"), []
    plan = read_tokenizer(str(folder), N_VOCAB, problems, notes)
    problems.raise_any()
    return plan, notes


def refusal(folder):
    with pytest.raises(ConvertError) as caught:
        keys_of(folder)
    return str(caught.value)


def test_vocab_and_merges_give_what_tokenizer_json_gives(tmp_path, qwen):
    write_vocab_files(tmp_path, qwen.tokenizer)
    slow, notes = keys_of(tmp_path)
    write_json(str(tmp_path / "tokenizer.json"), qwen.tokenizer)
    assert slow == keys_of(tmp_path)[0]
    assert any("vocab.json and merges.txt" in note for note in notes)


def test_vocab_and_merges_need_the_class_that_says_how_text_is_split(tmp_path, qwen):
    write_vocab_files(tmp_path, qwen.tokenizer, tokenizer_class="TokenizersBackend")
    assert "tokenizer_class: expected Qwen2Tokenizer or Qwen2TokenizerFast" in refusal(tmp_path)


def test_an_added_token_without_flags_or_under_another_id_is_refused(tmp_path, qwen):
    write_vocab_files(tmp_path, qwen.tokenizer)
    write_json(str(tmp_path / "added_tokens.json"), {"<img>": 5, SPECIAL[0]: 1})
    problem = refusal(tmp_path)
    assert "added_tokens.json: <img>" in problem and "added_tokens.json: " + SPECIAL[0] in problem


def test_merges_that_are_no_text_or_no_pairs_are_refused(tmp_path, qwen):
    write_vocab_files(tmp_path, qwen.tokenizer)
    (tmp_path / "merges.txt").write_bytes(b"\xff\xfe")
    assert "expected UTF-8 text" in refusal(tmp_path)
    (tmp_path / "merges.txt").write_text("a\n")
    assert "model.merges[0]" in refusal(tmp_path)


def test_a_folder_without_any_tokenizer_says_what_was_looked_for(tmp_path):
    assert "no vocab.json with merges.txt" in refusal(tmp_path)

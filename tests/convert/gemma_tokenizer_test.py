# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The keys of a tokenizer with byte fallback, and what of a Gemma-shaped tokenizer.json is refused."""

import json

import pytest

from tiny_pi import BLANK, N_VOCAB, TinyPi


def keys_of(converter, tiny):
    return converter.bundle(tiny).keys


def test_vocabulary_merges_and_prefix_are_those_of_the_file(converter):
    tiny = TinyPi("pi0")
    keys = keys_of(converter, tiny)
    model = tiny.tokenizer["model"]
    assert keys["tokenizer.kind"] == "byte_fallback_bpe"
    assert {text: i for i, text in enumerate(keys["tokenizer.tokens"])} == model["vocab"]
    assert keys["tokenizer.merges"] == [" ".join(merge) for merge in model["merges"]]
    assert keys["tokenizer.prefix_ids"] == [2]
    assert "tokenizer.pre" not in keys and "tokenizer.ignore_merges" not in keys


def test_a_blank_in_front_of_every_text_is_told(converter):
    tiny = TinyPi()
    tiny.tokenizer["normalizer"] = {
        "type": "Sequence",
        "normalizers": [{"type": "Prepend", "prepend": BLANK}, {"type": "Replace", "pattern": {"String": " "}, "content": BLANK}],
    }
    assert keys_of(converter, tiny)["tokenizer.normalization"] == "blank_first"
    assert "tokenizer.normalization" not in keys_of(converter, TinyPi())


def test_a_token_beyond_the_embedding_is_kept_without_a_row(converter):
    added = {token["content"]: token["id"] for token in json.loads(keys_of(converter, TinyPi())["tokenizer.added"])}
    assert added["<image>"] == -1 and added["<bos>"] == 2


def test_a_hole_in_the_vocabulary_gets_a_text_that_no_word_contains(converter):
    tiny = TinyPi()
    del tiny.tokenizer["model"]["vocab"]["<unused1>"], tiny.tokenizer["added_tokens"][-1]
    tokens = keys_of(converter, tiny)["tokenizer.tokens"]
    assert len(tokens) == N_VOCAB and " " in tokens[-2]


def test_without_a_template_nothing_stands_in_front(converter):
    tiny = TinyPi()
    tiny.tokenizer["post_processor"] = None
    assert keys_of(converter, tiny)["tokenizer.prefix_ids"] == []


def test_a_tab_in_the_place_of_its_byte_is_taken_as_published(converter):
    tiny = TinyPi()
    vocab = tiny.tokenizer["model"]["vocab"]
    vocab["\t"] = vocab.pop("<0x09>")
    assert keys_of(converter, tiny)["tokenizer.tokens"][vocab["\t"]] == "\t"


def model(**values):
    return lambda tiny: tiny.tokenizer["model"].update(values)


def spec(**values):
    return lambda tiny: tiny.tokenizer.update(values)


def config(**values):
    return lambda tiny: tiny.tokenizer_config.update(values)


def remove(text):
    return lambda tiny: tiny.tokenizer["model"]["vocab"].pop(text)


def added(**values):
    return lambda tiny: tiny.tokenizer["added_tokens"][-1].update(values)


AFTER = [{"Sequence": {"id": "A", "type_id": 0}}, {"SpecialToken": {"id": "<eos>", "type_id": 0}}]
SPLIT = {"type": "Split", "pattern": {"Regex": "\\d"}, "behavior": "Isolated", "invert": False}
REFUSED = {
    "model.ignore_merges: expected False, found True": model(ignore_merges=True),
    "model.dropout: expected None, found 0.5": model(dropout=0.5),
    "model.vocab: expected all 256 byte symbols, found 1 missing, the first is '<0x41>'": remove("<0x41>"),
    "found 1 missing, the first is '<0xC3>'": remove("<0xC3>"),
    "normalizer: expected blanks replaced by U+2581, and at most one in front of them before, found null": spec(normalizer=None),
    "normalizer: expected blanks replaced by U+2581, and at most one in front of them before, found {": spec(
        normalizer={"type": "Sequence", "normalizers": [{"type": "Prepend", "prepend": BLANK}]}
    ),
    "pre_tokenizer: expected none, or Split at blanks": spec(pre_tokenizer=SPLIT),
    "post_processor: expected a template of special tokens and then the text": spec(
        post_processor={"type": "TemplateProcessing", "single": AFTER, "special_tokens": {}}
    ),
    "post_processor.special_tokens: expected an id below": lambda tiny: tiny.tokenizer["post_processor"].update(
        special_tokens={"<bos>": {"ids": [N_VOCAB]}}
    ),
    "add_eos_token: expected False, found True": config(add_eos_token=True),
    "add_bos_token: expected True, as the template of tokenizer.json has it": config(add_bos_token=False),
    "tokenizer_class: expected": config(tokenizer_class="LlamaTokenizer"),
    "mask_token: expected a token among the added tokens": lambda tiny: tiny.tokenizer["added_tokens"].pop(4),
    "single characters that the model's vocabulary has too, found 'z'": added(content="z"),
    "model.merges[5]: expected two tokens whose union is a token": lambda tiny: tiny.tokenizer["model"]["merges"].append(
        ["p", "<eos>"]
    ),
    "added_tokens: expected tokens with id and content": added(id=-1),
    "a newline in no token but its own runs, found 'e\\n'": lambda tiny: tiny.tokenizer["model"]["vocab"].update(
        {"e\n": tiny.tokenizer["model"]["vocab"].pop("<unused2>")}
    ),
}


@pytest.mark.parametrize("message", REFUSED)
def test_a_tokenizer_that_the_runtime_does_not_follow_is_refused_by_field(converter, message):
    tiny = TinyPi("pi0")
    REFUSED[message](tiny)
    assert message in converter.refusal(tiny).message()


def test_a_folder_without_a_tokenizer_names_the_option(converter, monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    folder = TinyPi("pi0").save(converter.folder)
    for name in ("tokenizer.json", "tokenizer_config.json"):
        (converter.folder / "tokenizer" / name).unlink()
    (converter.folder / "tokenizer").rmdir()
    assert "--backbone" in converter.refusal().message()
    with pytest.raises(Exception, match="a folder"):
        converter.bundle(backbone=folder + "/nowhere")

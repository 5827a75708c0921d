# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The tokenizer's keys: enough to rebuild it exactly, and nothing that the runtime does not implement."""

import json
from pathlib import Path

import pytest
from tokenizers import AddedToken, Regex, Tokenizer, models, normalizers, pre_tokenizers

from tiny import N_VOCAB, SPECIAL, Tiny, byte_alphabet, write_json
from vla_cpp.convert import Code, ConvertError
from vla_cpp.convert.errors import Problems
from vla_cpp.convert.tokenizer import read_tokenizer
from vla_cpp.convert.tokenizer_byte_level import byte_symbols

TOKENIZERS = Path(__file__).resolve().parents[1] / "golden/tokenizers"
STRINGS = [
    "pick up the top\n",
    "to top 12 top",
    "  1  a  ",
    "in in\u00e9 \u4e2d\u6587 \U0001f642",
    "<image>top<|end|> to",
    "it's 3.5\u00b2 \u0661\u0662",
    "\t\r\n \u00a0\u2003x",
    "",
]


def rebuilt(keys):
    """The tokenizer that a reader of docs/bundle.md builds from the keys alone."""
    tokens, added = keys["tokenizer.tokens"], json.loads(keys["tokenizer.added"])
    # Added tokens above the model's own vocabulary are no tokens of the model.
    own = {token["content"]: token["id"] for token in added}
    vocab = {text: i for i, text in enumerate(tokens) if text not in own or own[text] == 0}
    merges = [tuple(merge.split(" ")) for merge in keys["tokenizer.merges"]]
    tokenizer = Tokenizer(models.BPE(vocab=vocab, merges=merges, ignore_merges=bool(keys["tokenizer.ignore_merges"])))
    make = {
        "digits": lambda s: pre_tokenizers.Digits(individual_digits=s["individual"]),
        "byte_level": lambda s: pre_tokenizers.ByteLevel(
            add_prefix_space=s["add_prefix_space"], use_regex=s["use_regex"]
        ),
        "split": lambda s: pre_tokenizers.Split(Regex(s["pattern"]), "isolated"),
    }
    assert keys.get("tokenizer.normalization", "nfc") == "nfc"
    if "tokenizer.normalization" in keys:
        tokenizer.normalizer = normalizers.NFC()
    tokenizer.pre_tokenizer = pre_tokenizers.Sequence(
        [make[step["type"]](step) for step in json.loads(keys["tokenizer.pre"])]
    )
    return tokenizer, added


def ids(keys, text):
    """Added tokens get their ids from the list, because a library numbers them anew."""
    tokenizer, added = rebuilt(keys)
    for token in added:
        tokenizer.add_special_tokens(
            [
                AddedToken(
                    token["content"], special=True, normalized=False, lstrip=token["lstrip"], rstrip=token["rstrip"]
                )
            ]
        )
    number = {token["content"]: token["id"] for token in added}
    encoding = tokenizer.encode(text, add_special_tokens=False)
    return [number.get(piece, i) for piece, i in zip(encoding.tokens, encoding.ids)]


def reference(tiny, text):
    return Tokenizer.from_str(json.dumps(tiny.tokenizer)).encode(text, add_special_tokens=False)


@pytest.mark.parametrize(
    "pretokenizers",
    [
        None,
        {"type": "ByteLevel", "add_prefix_space": True, "trim_offsets": True, "use_regex": True},
        {
            "type": "Sequence",
            "pretokenizers": [
                {"type": "Digits", "individual_digits": False},
                {"type": "ByteLevel", "add_prefix_space": False, "trim_offsets": True, "use_regex": True},
            ],
        },
        {"type": "ByteLevel", "add_prefix_space": False, "trim_offsets": True, "use_regex": False},
    ],
)
def test_a_tokenizer_rebuilt_from_the_keys_gives_the_same_ids(converter, tiny, pretokenizers):
    if pretokenizers:
        tiny.tokenizer["pre_tokenizer"] = pretokenizers
    keys = converter.bundle(tiny).keys
    for text in STRINGS:
        assert ids(keys, text) == reference(tiny, text).ids, text


def test_byte_symbols_are_those_of_the_library():
    assert sorted(byte_symbols()) == sorted(pre_tokenizers.ByteLevel.alphabet()) and byte_symbols() == byte_alphabet()


def test_merges_spelled_as_strings_and_as_pairs_give_the_same_bundle(converter, tiny):
    converter.bundle(tiny)
    first = open(converter.out, "rb").read()
    tiny.tokenizer["model"]["merges"] = [" ".join(pair) for pair in tiny.tokenizer["model"]["merges"]]
    converter.bundle(tiny)
    assert open(converter.out, "rb").read() == first


def test_holes_in_the_vocabulary_get_texts_that_no_text_can_become(converter, tiny):
    vocab = tiny.tokenizer["model"]["vocab"]
    vocab["hole"] = len(vocab) + 4
    tokens = converter.bundle(tiny).keys["tokenizer.tokens"]
    last = vocab["hole"]
    assert len(tokens) == last + 1 and tokens[last] == "hole"
    assert tokens[last - 1] == "<no token {}>".format(last - 1)
    assert len(set(tokens)) == len(tokens) and " " not in "".join(byte_symbols())


def test_an_added_token_inside_the_vocabulary_is_listed_with_its_flags(converter, tiny):
    added = json.loads(converter.bundle(tiny).keys["tokenizer.added"])
    assert added[0] == {
        "id": 0,
        "content": SPECIAL[0],
        "single_word": False,
        "lstrip": False,
        "rstrip": False,
        "normalized": False,
        "special": True,
    }


def test_the_gpt2_class_brings_a_pre_tokenizer_of_its_own(converter, tiny):
    tiny.tokenizer_config = {
        "tokenizer_class": "GPT2Tokenizer",
        **dict.fromkeys(("unk_token", "bos_token", "eos_token"), SPECIAL[0]),
    }
    keys = converter.bundle(tiny).keys
    assert json.loads(keys["tokenizer.pre"]) == [{"type": "byte_level", "add_prefix_space": False, "use_regex": True}]
    assert any("GPT2Tokenizer" in note for note in converter.summary.notes)


@pytest.mark.parametrize(
    "stated, in_file, side",
    [(None, None, "right"), ("left", None, "left"), (None, "Left", "left"), ("right", "Left", "right")],
)
def test_a_long_text_is_cut_on_the_side_that_the_tokenizer_states(converter, tiny, stated, in_file, side):
    """The config's side counts before the file's; taken from transformers by running it."""
    if stated:
        tiny.tokenizer_config["truncation_side"] = stated
    if in_file:
        tiny.tokenizer["truncation"] = {"direction": in_file, "max_length": 9, "strategy": "LongestFirst", "stride": 0}
    recipe = json.loads(converter.bundle(tiny).keys["processor.recipe"])
    assert recipe["text"][-1] == {"op": "tokenize", "max_tokens": 7, "truncate": side}


def test_a_template_that_adds_nothing_is_accepted(converter, tiny):
    tiny.tokenizer["post_processor"] = {
        "type": "TemplateProcessing",
        "single": [{"Sequence": {"id": "A", "type_id": 0}}],
        "pair": [],
        "special_tokens": {},
    }
    assert converter.bundle(tiny).keys["tokenizer.kind"] == "byte_level_bpe"


def model(**values):
    return lambda t: t.tokenizer["model"].update(values)


def spec(**values):
    return lambda t: t.tokenizer.update(values)


def settings(**values):
    return lambda t: t.tokenizer_config.update(values)


SEQUENCE = {"type": "Sequence", "pretokenizers": [{"type": "ByteLevel"}, {"type": "Digits"}]}
BOS = [{"SpecialToken": {"id": "<|end|>", "type_id": 0}}, {"Sequence": {"id": "A", "type_id": 0}}]
UNSUPPORTED, BAD = Code.UNSUPPORTED, Code.BAD_BUNDLE
CASES = {
    "model.type: expected 'BPE', found 'Unigram'": (model(type="Unigram"), UNSUPPORTED),
    "model.dropout: expected None, found 0.1": (model(dropout=0.1), UNSUPPORTED),
    "model.byte_fallback: expected False, found 1": (model(byte_fallback=1), UNSUPPORTED),
    "model.continuing_subword_prefix: expected None, found '##'": (model(continuing_subword_prefix="##"), UNSUPPORTED),
    "model.end_of_word_suffix: expected None, found '</w>'": (model(end_of_word_suffix="</w>"), UNSUPPORTED),
    "normalizer: expected none or NFC, found": (spec(normalizer={"type": "NFKC"}), UNSUPPORTED),
    'pre_tokenizer: expected Digits, the Split of Qwen2 or Llama 3 and ByteLevel, found {"type":"Metaspace"': (
        spec(pre_tokenizer={"type": "Metaspace"}),
        UNSUPPORTED,
    ),
    "pre_tokenizer: expected Digits, the Split of Qwen2 or Llama 3 and ByteLevel, found null": (spec(pre_tokenizer=None), UNSUPPORTED),
    "pre_tokenizer: expected ByteLevel once, as the last step": (spec(pre_tokenizer=SEQUENCE), UNSUPPORTED),
    "post_processor: expected a template of special tokens and then the text": (
        spec(post_processor={"type": "TemplateProcessing", "single": BOS[::-1]}),
        UNSUPPORTED,
    ),
    "post_processor.special_tokens: expected an id below": (spec(post_processor={"type": "TemplateProcessing", "single": BOS}), BAD),
    "added_tokens: expected tokens with id and content": (spec(added_tokens=[{"id": "0", "content": "x"}]), BAD),
    "tokenizer_class: expected TokenizersBackend or": (settings(tokenizer_class="LlamaTokenizer"), UNSUPPORTED),
    "truncation_side: expected 'left' or 'right', found 'middle'": (settings(truncation_side="middle"), UNSUPPORTED),
    "add_bos_token: expected False, as the template of tokenizer.json has it, found True": (settings(add_bos_token=True), BAD),
    "split_special_tokens: expected False, found True": (settings(split_special_tokens=True), UNSUPPORTED),
    "pad_token: expected a token among the added tokens of tokenizer.json, found '<pad>'": (
        settings(pad_token="<pad>"),
        BAD,
    ),
    "bos_token: expected a token among": (settings(tokenizer_class="GPT2Tokenizer"), BAD),
    "added_tokens_decoder.5: expected the token as tokenizer.json has it": (
        settings(added_tokens_decoder={"5": {"content": "<|end|>", "special": True}}),
        BAD,
    ),
    "model.vocab: expected tokens with ids": (model(vocab={}), BAD),
    "model.vocab: expected all 256 byte symbols, found 1 missing, the first is 'Q'": (
        lambda t: t.tokenizer["model"]["vocab"].pop("Q"),
        BAD,
    ),
    "ids: expected ids below vocab_size 300, found 1 above, the first is 300 ('<late>')": (
        lambda t: t.tokenizer["added_tokens"].extend(
            {"id": i, "content": "<late>" if i == N_VOCAB else "<{}>".format(i)}
            for i in range(t.tokenizer["added_tokens"][-1]["id"] + 1, N_VOCAB + 1)
        ),
        BAD,
    ),
    "id 9: expected one token": (lambda t: t.tokenizer["model"]["vocab"].update({"twice": 9}), BAD),
    "model.merges[1]: expected two tokens whose union is a token": (
        lambda t: t.tokenizer["model"]["merges"].insert(1, ["t", "q"]),
        BAD,
    ),
    "model.merges[0]: expected two tokens": (lambda t: t.tokenizer["model"].update(merges=["t o o"]), BAD),
    "model.merges: expected a list": (lambda t: t.tokenizer["model"].update(merges=None), BAD),
}


def token(number, content):
    return {"id": number, "content": content, **dict.fromkeys(("single_word", "lstrip", "rstrip", "normalized"), False), "special": True}


@pytest.mark.parametrize(
    "change",
    [
        lambda added: added[-1].update(id=added[-1]["id"] + 5),  # a hole
        lambda added: added.append(token(added[-1]["id"], "<twice>")),  # one id for two
        lambda added: added.append(token(270, "Q")),  # another id than the model's
        lambda added: added.extend([token(290, "<b>"), token(280, "<a>")]),
        lambda added: added.append(token(299, added[-1]["content"])),  # one token with two ids
    ],
)
def test_added_tokens_have_the_ids_that_the_library_gives_them(converter, tiny, change):
    change(tiny.tokenizer["added_tokens"])
    bundle = converter.bundle(tiny)
    library = Tokenizer.from_str(json.dumps(tiny.tokenizer))
    added = json.loads(bundle.keys["tokenizer.added"])
    assert {t["content"]: t["id"] for t in added} == {t.content: i for i, t in library.get_added_tokens_decoder().items()}
    assert any("other ids than the file states" in note for note in converter.summary.notes)


@pytest.mark.parametrize("message", CASES)
def test_another_tokenizer_is_refused_by_field(converter, tiny, message):
    change, code = CASES[message]
    change(tiny)
    error = converter.refusal(tiny)
    assert message in error.message()
    assert error.code == code


def test_an_unknown_token_is_no_obstacle_because_no_byte_is_unknown(converter, tiny):
    tiny.tokenizer["model"]["unk_token"] = SPECIAL[0]
    assert converter.bundle(tiny).keys["tokenizer.kind"] == "byte_level_bpe"


def test_a_token_that_is_no_unicode_text_is_refused(converter, tiny):
    converter.save(tiny)
    path = converter.folder / "vlm" / "tokenizer.json"
    path.write_text(path.read_text().replace('"<image>"', '"\\ud800"'))
    assert "model.vocab: expected UTF-8 text" in converter.refusal().message()


def test_a_tokenizer_without_tokenizer_json_is_told_how_to_get_one(converter):
    converter.save(Tiny())
    (converter.folder / "vlm" / "tokenizer.json").unlink()
    write_json(str(converter.folder / "vlm" / "vocab.json"), {})
    error = converter.refusal()
    assert "save it again" in error.message() and error.code == Code.IO


# --- what transformers builds anew, whatever tokenizer.json says --------------------------------------------------------------------------


def read(tmp_path, name, change, model_type=None):
    """The keys of a tokenizer of tests/golden with changed files, and the notes."""
    files = {file: json.loads((TOKENIZERS / name / file).read_text()) for file in ("tokenizer.json", "tokenizer_config.json")}
    change(*files.values())
    for file, value in files.items():
        write_json(tmp_path / file, value)
    if model_type:
        write_json(tmp_path / "config.json", {"model_type": model_type})
    problems, notes = Problems(str(tmp_path)), []
    plan = read_tokenizer(str(tmp_path), 1024, problems, notes)
    problems.raise_any()
    return {key.name: key.value for key in plan.keys}, notes


def without(spec, config):
    del spec["post_processor"]


def unnamed(spec, config):
    del config["tokenizer_class"]


@pytest.mark.parametrize("name, front, behind", [("bert", [2], [3]), ("bart", [0], [2])])
def test_a_class_that_builds_the_template_does_so_where_the_file_has_none(tmp_path, name, front, behind):
    keys, notes = read(tmp_path, name, without)
    assert keys["tokenizer.prefix_ids"] == front and keys["tokenizer.suffix_ids"] == behind
    assert any("no post_processor" in note for note in notes)


def test_a_template_that_contradicts_the_class_is_refused(tmp_path):
    def ends(spec, config):
        spec["post_processor"]["single"] = spec["post_processor"]["single"][1:]

    with pytest.raises(ConvertError, match=r"post_processor: expected \[CLS\] and \[SEP\] of tokenizer_config.json"):
        read(tmp_path, "bert", ends)


def test_a_models_config_in_the_folder_names_the_class(tmp_path):
    def spaced(spec, config):
        unnamed(spec, config)
        spec["pre_tokenizer"]["add_prefix_space"] = True

    assert json.loads(read(tmp_path, "bart", spaced)[0]["tokenizer.pre"])[0]["add_prefix_space"] is True
    assert json.loads(read(tmp_path, "bart", spaced, "bart")[0]["tokenizer.pre"])[0]["add_prefix_space"] is False
    assert read(tmp_path, "bert", lambda *files: (unnamed(*files), without(*files)), "bert")[0]["tokenizer.prefix_ids"] == [2]


def test_a_class_of_another_model_than_the_folders_leaves_the_file_as_it_is(tmp_path):
    def spaced(spec, config):
        spec["pre_tokenizer"]["add_prefix_space"] = True

    assert json.loads(read(tmp_path, "bart", spaced, "bert")[0]["tokenizer.pre"])[0]["add_prefix_space"] is True


def test_a_class_that_takes_its_tokens_from_the_config_needs_all_of_them_there(tmp_path):
    with pytest.raises(ConvertError, match="added_tokens_decoder: expected all added tokens of tokenizer.json, since Qwen2Tokenizer"):
        read(tmp_path, "evo1", lambda spec, config: config["added_tokens_decoder"].pop("318"))

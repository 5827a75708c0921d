# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""A SentencePiece model in the place of tokenizer.json: sentencepiece itself trains it here, and judges what became of it."""

import io
import json
import random

import pytest
import sentencepiece
from sentencepiece import sentencepiece_model_pb2
from tokenizers import Tokenizer

from tiny_pi import BLANK, N_VOCAB, TinyPi
from vla_cpp.convert import Code, tokenizer_sentencepiece
from vla_cpp.convert.errors import ConvertError, Problems

SENTENCES = [
    "pick up the red cube and place it in the bowl",
    "open the top drawer 10 cm, close it after 3.5 s; don't drop the cup",
    "heb den roten Würfel auf und lege ihn in die Schüssel",
    "拿起红色的方块放进碗里 возьми красный кубик",
    "Task: push it, State: 12 255 -1 0 128;\nAction: ",
]
RUNS = ["\n" * n for n in range(1, 5)] + [BLANK * n for n in range(2, 6)]
# Gemma's settings, as far as a model states them.
GEMMA = dict(
    model_type="bpe",
    byte_fallback=True,
    normalization_rule_name="identity",
    add_dummy_prefix=False,
    remove_extra_whitespaces=False,
    allow_whitespace_only_pieces=True,
    split_digits=True,
    user_defined_symbols=["<mask>", *RUNS, "<loc0000>"],
    vocab_size=420,
    character_coverage=0.98,
)
NAMES = {i: name for i, name in enumerate(("pad", "eos", "bos", "unk"))}


def train(sentences=SENTENCES, **settings):
    ids = {"{}_id".format(name): i for i, name in NAMES.items()}
    pieces = {"{}_piece".format(name): "<{}>".format(name) for name in NAMES.values()}
    model = io.BytesIO()
    sentencepiece.SentencePieceTrainer.train(
        sentence_iterator=iter(sentences * 3), model_writer=model, minloglevel=2, **{**GEMMA, **ids, **pieces, **settings}
    )
    return model.getvalue()


@pytest.fixture(scope="module")
def model():
    return train()


def spec_of(folder, model):
    (folder / "tokenizer.model").write_bytes(model)
    problems = Problems("test")
    spec = tokenizer_sentencepiece.read_spec(str(folder / "tokenizer.model"), problems)
    return spec, problems


def fuzzed(count):
    """Sentences cut and joined anywhere, runs of blanks and lines, added tokens, characters from everywhere."""
    rng = random.Random(5)
    for _ in range(count):
        text = ""
        while rng.random() < 0.8:
            sentence, start = rng.choice(SENTENCES), rng.randrange(40)
            pieces = (sentence[start : start + rng.randrange(20)], " " * rng.randrange(9), "\n" * rng.randrange(6), "\t" * rng.randrange(3))
            text += rng.choice([*pieces, "<loc0000>", "<mask>", chr(rng.choice((0x20, 0x370, 0x4E00, 0x1F600)) + rng.randrange(90))])
        yield text


def test_text_gives_the_ids_of_sentencepiece(tmp_path, model):
    spec, problems = spec_of(tmp_path, model)
    assert problems.list == []
    empty = {"version": "1.0", "truncation": None, "padding": None, "pre_tokenizer": None, "decoder": None}
    converted = Tokenizer.from_str(json.dumps({**empty, **spec}))
    judge = sentencepiece.SentencePieceProcessor(model_proto=model)
    texts = [*SENTENCES, *fuzzed(5000)]
    assert [e.ids for e in converted.encode_batch(texts)] == judge.encode(texts, add_bos=True)


def test_the_best_piece_is_merged_first_and_runs_grow_from_the_left(tmp_path, model):
    merges = [tuple(merge) for merge in spec_of(tmp_path, model)[0]["model"]["merges"]]
    runs = [merge for merge in merges if set("".join(merge)) == {BLANK}]
    assert runs == sorted(runs, key=lambda merge: (-len(merge[0]), -len(merge[1]))) and (BLANK, BLANK) in runs
    pieces = {p.piece: p.score for p in sentencepiece_model_pb2.ModelProto.FromString(model).pieces}
    scores = [pieces["".join(merge)] for merge in merges]
    assert scores == sorted(scores, reverse=True) and len(set(scores)) > 20


@pytest.mark.parametrize("name", tokenizer_sentencepiece.FILES)
def test_a_checkpoint_converts_with_the_model_alone(converter, name):
    tiny = TinyPi("pi0")
    tiny.save(converter.folder)
    for file in ("tokenizer.json", "tokenizer_config.json"):
        (converter.folder / "tokenizer" / file).unlink()
    (converter.folder / "tokenizer" / name).write_bytes(train(["pick up the cup"], vocab_size=N_VOCAB, user_defined_symbols=["<mask>", "\n"]))
    bundle = converter.bundle()
    tokens = bundle.keys["tokenizer.tokens"]
    assert bundle.keys["tokenizer.kind"] == "byte_fallback_bpe" and bundle.keys["tokenizer.prefix_ids"] == [2]
    assert tokens[:5] == ["<pad>", "<eos>", "<bos>", "<unk>", "<mask>"] and "\t" in tokens and "<0x0A>" in tokens


def setting(part, **values):
    def change(proto):
        for key, value in values.items():
            setattr(getattr(proto, part), key, value)

    return change


REFUSED = {
    "trainer_spec.byte_fallback: expected True as in Gemma's, found False": setting("trainer_spec", byte_fallback=False),
    "trainer_spec.model_type: expected 2 as in Gemma's, found 1": setting("trainer_spec", model_type=1),
    "trainer_spec.treat_whitespace_as_suffix: expected False": setting("trainer_spec", treat_whitespace_as_suffix=True),
    "normalizer_spec.add_dummy_prefix: expected False": setting("normalizer_spec", add_dummy_prefix=True),
    "normalizer_spec.remove_extra_whitespaces: expected False": setting("normalizer_spec", remove_extra_whitespaces=True),
    "normalizer_spec.escape_whitespaces: expected True": setting("normalizer_spec", escape_whitespaces=False),
    "normalizer_spec.precompiled_charsmap: expected 0": setting("normalizer_spec", precompiled_charsmap=b"rules"),
    "pieces: expected pieces that are all used, found pieces of type [5]": lambda proto: setattr(proto.pieces[-1], "type", 5),
}


@pytest.mark.parametrize("message", REFUSED)
def test_a_model_with_other_settings_is_refused_by_field(tmp_path, model, message):
    proto = sentencepiece_model_pb2.ModelProto.FromString(model)
    REFUSED[message](proto)
    _, problems = spec_of(tmp_path, proto.SerializeToString())
    with pytest.raises(ConvertError) as refused:
        problems.raise_any()
    assert refused.value.code == Code.UNSUPPORTED and message in refused.value.message()


def test_a_damaged_model_is_refused(tmp_path, model):
    proto = sentencepiece_model_pb2.ModelProto.FromString(model)
    proto.pieces[-1].score = float("nan")
    no_text = model.replace(b"<loc0000>", b"<loc\xff000>")
    for data in (model[:-7], b"no model at all", b"", no_text, proto.SerializeToString()):
        with pytest.raises(ConvertError, match="expected a SentencePiece model"):
            spec_of(tmp_path, data)

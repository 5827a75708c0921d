# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""π0-FAST: names against the reference's, what a bundle holds, and every field that is refused."""

import json

import pytest

from goldens import pi0_fast
from goldens.parameters import tower
from goldens.pi import gemma
from vla_cpp.convert import ConvertError, Options, convert_checkpoint, read_bundle
from vla_cpp.convert.archs import load
from vla_cpp.convert.archs.pi0 import mapping
from vla_cpp.convert.checkpoint import open_checkpoint
from vla_cpp.convert.errors import Code, Problems

ARCH = "pi0_fast"
SMALL = pi0_fast.Checkpoint(
    pi0_fast.policy((6, 5), 7, 28, 20), tower(6, 1, 2, 10), gemma(12, 2, 3, 1, 4, 14), {"base": (20, 28), "wrist": (36, 36)}, d_action=4
)
LAYER = ["attn_norm", "attn_q", "attn_k", "attn_v", "attn_out", "ffn_norm", "ffn_gate", "ffn_up", "ffn_down"]
PRE, POST = "policy_preprocessor.json", "policy_postprocessor.json"
ACTIONS = "action_tokenizer/processor_config.json"
FAST, FAST_CONFIG = "action_tokenizer/bpe_tokenizer/tokenizer.json", "action_tokenizer/bpe_tokenizer/tokenizer_config.json"


def test_every_tensor_of_the_reference_is_read_and_every_layer_is_whole(planned):
    _, plan = planned()
    shapes = SMALL.shapes()
    assert {row.source for row in plan.weights} == set(shapes) and all(row.stored == shapes[row.source] for row in plan.weights)
    rows = {row.target: row for row in plan.weights}
    assert len(rows) == len(plan.weights)
    for i in range(2):
        assert {name for name in rows if name.startswith("lm.blk.{}.".format(i))} == {"lm.blk.{}.{}.weight".format(i, part) for part in LAYER}
    assert rows["lm.norm.weight"].plus_one and rows["lm.blk.1.ffn_norm.weight"].plus_one
    assert (rows["lm.head.weight"].kind, rows["lm.token_embd.weight"].kind) == ("matrix", "table")
    assert rows["lm.head.weight"].source == rows["lm.token_embd.weight"].source == mapping.LM_HEAD


@pytest.mark.parametrize("stored, head", [((mapping.LM_HEAD, mapping.EMBEDDING), mapping.LM_HEAD), ((mapping.EMBEDDING,), mapping.EMBEDDING)])
def test_head_and_embedding_may_be_two_tensors_or_the_embedding_alone(folder, stored, head):
    checkpoint = open_checkpoint(str(folder), {})
    entry = checkpoint.tensors.pop(mapping.LM_HEAD)
    checkpoint.tensors.update({name: entry._replace(name=name) for name in stored})
    rows = {row.target: row.source for row in load(ARCH).plan(checkpoint, Options(), Problems("test")).weights}
    assert (rows["lm.head.weight"], rows["lm.token_embd.weight"]) == (head, mapping.EMBEDDING)


def test_the_keys_of_a_bundle(planned):
    keys, _ = planned()
    assert (keys["policy.d_state"], keys["policy.d_action"], keys["policy.horizon"]) == (0, 4, 5)
    assert (keys["solver.kind"], keys["solver.steps"], keys["solver.noise"]) == ("greedy", 7, "none")
    assert keys["lm.n_vocab"] == SMALL.n_vocab and keys["policy.text_scale"] == 12**0.5
    tokens = keys["tokenizer.tokens"]
    assert tokens[keys["solver.stop_token"]] == "|" and [tokens[i] for i in keys["action_tokens.prefix_ids"]] == ["Action", ":", "\u2581"]
    assert keys["action_tokens.required_ids"] == keys["action_tokens.prefix_ids"][:2]
    assert keys["action_tokens.first_id"] == SMALL.n_vocab - 1 - 5
    assert (keys["action_tokens.kind"], keys["action_tokens.scale"], keys["action_tokens.min_token"]) == ("fast", 10.0, -80.0)
    vocab, own = keys["action_tokens.vocab"], SMALL.fast.vocabulary()[0]
    assert len(vocab) == len(own) and vocab[ord("P")] == "P" and all(vocab[i] == token for token, i in own.items() if i >= SMALL.fast.n_character)
    assert vocab[:2] == ["\u0100", "\u0101"] and vocab[130] == "\u00c2\u0124"  # bytes of U+0000, U+0001 and U+0082


def test_the_prompt_stands_between_two_beginnings_and_its_limit_does_not_count_the_second_one(planned):
    keys, _ = planned()
    bos = keys["tokenizer.tokens"].index("<bos>")
    assert keys["tokenizer.prefix_ids"] == keys["tokenizer.suffix_ids"] == [bos]
    recipe = json.loads(keys["processor.recipe"])
    assert recipe["text"][-2:] == [
        {"op": "template", "text": "Task: {instruction}, State: {state};\n"},
        {"op": "tokenize", "max_tokens": 21, "truncate": "right"},
    ]
    assert keys["observation.max_text_tokens"] == 21
    assert recipe["state"][-1] == {"op": "bins", "low": -1.0, "high": 1.0, "count": 256}
    assert not any(op["op"] in ("pad", "take") for op in recipe["state"] + recipe["action"])


def test_without_its_check_no_ids_are_required(planned):
    keys, _ = planned(path="validate_action_token_prefix", value=False)
    assert keys["action_tokens.required_ids"] == []


@pytest.mark.parametrize("path, value", [("use_kv_cache", False), ("max_action_tokens", 9), ("tokenizer_max_length", 7), ("temperature", 0)])
def test_what_changes_no_number_is_passed_over(folder, planned, path, value):
    plan = load(ARCH).plan(open_checkpoint(str(folder), {}), Options(), Problems("test"))
    keys, _ = planned(path=path, value=value)
    assert keys == {key.name: key.value for key in plan.keys}


def test_an_older_tokenizer_of_actions_has_its_files_beside_the_processor(folder, tmp_path):
    source = folder / "action_tokenizer"
    for file in ("processor_config.json", "bpe_tokenizer/tokenizer.json", "bpe_tokenizer/tokenizer_config.json"):
        (tmp_path / file.split("/")[-1]).write_bytes((source / file).read_bytes())
    out = tmp_path / "out.gguf"
    convert_checkpoint(str(folder), str(out), Options(action_tokenizer=str(tmp_path), vla="none"))
    assert len(read_bundle(str(out)).keys["action_tokens.vocab"]) == len(SMALL.fast.vocabulary()[0])


REFUSED = [
    ("config.json", "temperature", 0.7, "config.json: temperature: expected 0.0"),
    ("config.json", "rtc_config", {"enabled": True}, "config.json: rtc_config: expected none, or enabled: false"),
    ("config.json", "rtc_config", {"execution_horizon": 3}, "config.json: rtc_config: expected none, or enabled: false"),
    ("config.json", "use_relative_actions", True, "config.json: use_relative_actions: expected False"),
    ("config.json", "max_decoding_steps", 0, "config.json: max_decoding_steps: expected a whole number"),
    ("config.json", "fast_skip_tokens", -1, "config.json: fast_skip_tokens: expected a whole number"),
    ("config.json", "fast_skip_tokens", 5000, "config.json: fast_skip_tokens: expected less than the"),
    ("config.json", "validate_action_token_prefix", 1, "config.json: validate_action_token_prefix: expected true or false"),
    ("config.json", "n_action_steps", 7, "config.json: n_action_steps: expected at most chunk_size 6"),
    ("config.json", "image_resolution", [42, 42], "config.json: image_resolution: expected the image_size of dims.json"),
    ("config.json", "dtype", "float16", "config.json: dtype: expected float32 or bfloat16"),
    ("config.json", "brand_new", 1, "config.json: brand_new: expected a key of PI0FastConfig"),
    ("dims.json", "gemma_2b/num_kv_heads", 2, "dims.json: gemma_2b: num_kv_heads: expected a divisor"),
    ("dims.json", "vocab_size", SMALL.n_vocab + 1, "tokenizer: id {}: expected a token for each".format(SMALL.n_vocab)),
    (PRE, "steps/4/registry_name", "pi05_prepare_state_tokenizer_processor_step", "expected one of"),
    (PRE, "steps/6/config/fast_skip_tokens", 7, "fast_skip_tokens: expected no such field"),
    (ACTIONS, "processor_class", "OtherProcessor", "processor_class: expected UniversalActionProcessor"),
    (ACTIONS, "min_token", 0.5, "min_token: expected a whole number"),
    (ACTIONS, "scale", 0, "scale: expected a number above"),
    (ACTIONS, "brand_new", 1, "brand_new: expected a key that this converter knows"),
    (FAST, "decoder", None, "decoder.type: expected ByteLevel, found None"),
    (FAST, "model/type", "Unigram", "model.type: expected BPE"),
    (FAST, "added_tokens", [{"id": 0, "content": "a"}], "added_tokens: expected none"),
    (FAST, "model/vocab", {}, "model.vocab: expected tokens with ids of their own, found 0 tokens"),
    (FAST, "model/vocab/a", -1, "model.vocab: expected tokens with ids of their own"),
    (FAST_CONFIG, "clean_up_tokenization_spaces", True, "clean_up_tokenization_spaces: expected none"),
    (FAST_CONFIG, "eos_token", "<eos>", "eos_token: expected none"),
    (FAST_CONFIG, "tokenizer_class", "LlamaTokenizer", "tokenizer_class: expected"),
    ("tokenizer/tokenizer.json", "post_processor", None, "tokenizer: expected <bos> in front of every text"),
]


@pytest.mark.parametrize("file, path, value, message", REFUSED)
def test_what_the_runtime_does_not_follow_is_refused(refusal, file, path, value, message):
    assert message in refusal(file=file, path=path, value=value)


def test_a_tokenizer_of_actions_is_needed_and_named(folder, refusal):
    text = refusal(without=["action_tokenizer"])
    assert "lerobot/fast-action-tokenizer" in text and "--action-tokenizer" in text


def test_the_option_is_refused_where_it_means_nothing(tmp_path):
    from tiny_pi import TinyPi

    TinyPi("pi0").save(tmp_path / "policy")
    with pytest.raises(ConvertError) as caught:
        convert_checkpoint(str(tmp_path / "policy"), str(tmp_path / "out.gguf"), Options(action_tokenizer=str(tmp_path)))
    assert "--action-tokenizer: expected a checkpoint of π0-FAST" in str(caught.value) and caught.value.code == Code.USAGE

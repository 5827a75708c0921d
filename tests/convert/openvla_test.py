# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""OpenVLA: names against the reference's and the runtime's, pixels that the towers standardize, statistics, prompt, refusals."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from goldens import openvla
from goldens.openvla import CASES, EMPTY, LM, MEANS, STDS, Tower
from goldens.parameters import decoder
from manifests import check_keys, check_parameters
from saved import Saved
from tokenizer_from_keys import ids_of, tokenizer_of
from vla_cpp.convert.archs.openvla import mapping
from vla_cpp.convert.errors import Code, Problems

SEED = 4
SMALL = openvla.Checkpoint(Tower(16, 2, 20), Tower(32, 3, 28), decoder(16, 2, 2, 1, 24))
PIXELS = [{"mean": tuple(mean), "std": tuple(std)} for mean, std in zip(MEANS, STDS)]


def saved(checkpoint=SMALL, **changes):
    return Saved(checkpoint, SEED, **changes)


def sizes_of(checkpoint, **config):
    """Of the config with the shapes of the tensors that the reference has."""
    problems, shapes = Problems("test"), checkpoint.shapes()
    stated = {**checkpoint.config(SEED), **config}
    opened = SimpleNamespace(config=stated, tensors={name: SimpleNamespace(shape=shape) for name, shape in shapes.items()})
    s = mapping.read_sizes(opened, problems)
    problems.raise_any()
    s.d_action = checkpoint.d_action
    return s


@pytest.fixture(scope="module")
def published():
    """With the text_config of openvla-7b, which leaves all sizes to LlamaConfig."""
    text = {"model_type": "llama", "pad_token_id": 32000, "torch_dtype": "bfloat16", "vocab_size": 32064}
    return sizes_of(openvla.published(), text_config=text)


def test_every_tensor_of_the_reference_is_read_or_dropped():
    s, shapes = sizes_of(SMALL), SMALL.shapes()
    read = {row.source: row.stored for row in mapping.weights(s, PIXELS)}
    unread = {row.source: row.stored for row in mapping.dropped(s)}
    assert read | unread == shapes and not read.keys() & unread.keys()
    assert not any("blocks.1." in name for name in read if "vision_backbone.featurizer" in name)


def test_names_shapes_and_storage_are_those_that_the_runtime_declares(published):
    check_parameters("openvla", mapping.weights(published, PIXELS))


def test_sizes_at_the_published_config_are_those_of_the_runtimes_manifest(published):
    check_keys("openvla", mapping.network_keys(published))
    count = sum(int(np.prod(row.stored)) for row in {row.source: row for row in mapping.weights(published, PIXELS)}.values())
    assert count == pytest.approx(7.5e9, rel=1e-2)


def test_the_stored_weights_read_pixels_from_0_to_1(converter):
    """The sum of a patch, of which the reference standardizes the pixels first."""
    bundle = converter.bundle(saved(), dtype="bf16", stats="bridge_orig")
    pixels = np.random.default_rng(0).random((3, 14, 14))
    for at, source, mean, std in (("dino", openvla.DINO, MEANS[0], STDS[0]), ("siglip", openvla.SIGLIP, MEANS[1], STDS[1])):
        weight, bias = (SMALL.value(name, SMALL.shapes()[name], SEED) for name in (f"{source}patch_embed.proj.{part}" for part in ("weight", "bias")))
        standard = (pixels - np.reshape(mean, (3, 1, 1))) / np.reshape(std, (3, 1, 1))
        expected = (weight * standard).sum((1, 2, 3)) + bias
        own = {part: bundle.tensors[f"{at}.patch_embed.{part}"] for part in ("weight", "bias")}
        assert bundle.dtypes[f"{at}.patch_embed.weight"] == "f32" and own["weight"].dtype == np.float32
        assert own["weight"].astype(float) @ pixels.ravel() + own["bias"] == pytest.approx(expected, abs=2e-6)
    assert bundle.dtypes["dino.blk.0.attn_q.weight"] == "bf16"


def test_stated_results_replace_the_means_they_would_be_made_from(converter):
    plain = converter.bundle(saved(), stats="bridge_orig").tensors["dino.patch_embed.bias"]
    other = {"means": [[0.25] * 3] * 2}
    stated = converter.bundle(saved(preprocessor_config=lambda c: c.update(other)), stats="bridge_orig")
    assert (stated.tensors["dino.patch_embed.bias"] == plain).all()
    made = converter.bundle(saved(preprocessor_config=lambda c: (c.update(other), c.pop("tvf_normalize_params"))), stats="bridge_orig")
    assert (made.tensors["dino.patch_embed.bias"] != plain).any()


def test_q_k_and_v_are_thirds_of_one_matrix(converter):
    tensors = converter.bundle(saved(), dtype="f32").tensors
    name = openvla.SIGLIP + "blocks.1.attn.qkv.weight"
    stacked = SMALL.value(name, SMALL.shapes()[name], SEED)
    for i, part in enumerate("qkv"):
        assert (tensors[f"siglip.blk.1.attn_{part}.weight"] == stacked[32 * i : 32 * (i + 1)]).all()
    name = LM + "layers.0.mlp.down_proj.weight"
    assert (tensors["lm.blk.0.ffn_down.weight"] == SMALL.value(name, SMALL.shapes()[name], SEED)).all()


def test_tokens_of_actions_end_the_vocabulary_without_its_padding(converter):
    keys = converter.bundle(saved()).keys
    assert keys["action_tokens.kind"] == "bins" and keys["action_tokens.n_bin"] == 256
    assert keys["action_tokens.first_id"] == openvla.N_TOKEN - 1 and keys["lm.n_vocab"] == openvla.N_TOKEN + 64
    assert keys["solver.kind"] == "greedy" and keys["solver.steps"] == 7 and keys["solver.stop_token"] == 2
    other = converter.bundle(saved(generation_config=lambda c: c.update(eos_token_id=5)))
    assert other.keys["solver.stop_token"] == 5
    unstated = saved(without=["generation_config.json"], config=lambda c: c["text_config"].update(eos_token_id=6))
    assert converter.bundle(unstated).keys["solver.stop_token"] == 6


def test_shards_make_the_same_bundle(converter):
    def content(bundle):
        return {name: tensor.tobytes() for name, tensor in bundle.tensors.items()}

    assert content(converter.bundle(saved(replace(SMALL, n_shard=3)))) == content(converter.bundle(saved()))


def test_the_prompt_ends_with_the_empty_token(converter):
    bundle = converter.bundle(saved())
    text = json.loads(bundle.keys["processor.recipe"])["text"]
    assert [op["op"] for op in text] == ["lower", "template", "tokenize"]
    tokenizer = tokenizer_of(bundle.keys)
    for instruction in ("pick up the cube", "öffne das 2. fach, 漢字", "<s> a </s>b", ""):
        prompt = "In: What action should the robot take to {}?\nOut:".format(instruction)
        assert text[1]["text"].format(instruction=instruction) == prompt
        assert ids_of(tokenizer, bundle.keys, prompt) == [1, *tokenizer.encode(prompt).ids, EMPTY]


def test_statistics_are_chosen_by_their_data_set(converter):
    several = replace(SMALL, other_stats=("fractal", "taco_play"))
    error = converter.refusal(saved(several))
    assert "expected one of bridge_orig, fractal, taco_play, found 3" in str(error)
    assert "found nowhere" in str(converter.refusal(stats="nowhere"))
    bundle = converter.bundle(stats="fractal")
    expected = several.statistics(SEED)["fractal"]["action"]
    for quantile in ("q01", "q99"):
        assert bundle.dtypes["stats.action." + quantile] == "f64"
        assert bundle.tensors["stats.action." + quantile].tolist() == expected[quantile]
    (op,) = json.loads(bundle.keys["processor.recipe"])["action"]
    assert op["columns"] == [0, 1, 2, 3, 4, 5]


def test_a_fine_tune_has_statistics_of_its_own(converter):
    case = CASES["openvla/fine_tuned"].checkpoint
    bundle = converter.bundle(saved(case))
    assert bundle.tensors["stats.action.q01"].tolist() == case.statistics(SEED)["bridge_orig"]["action"]["q01"]
    (op,) = json.loads(bundle.keys["processor.recipe"])["action"]
    assert op["columns"] == [0, 1, 2, 3] and bundle.keys["policy.d_action"] == bundle.keys["solver.steps"] == 4
    assert bundle.keys["action_tokens.n_bin"] == 64 and bundle.keys["lm.rope_base"] == 5000.0


def text(**values):
    return {"config": lambda c: c["text_config"].update(values)}


def top(**values):
    return {"config": lambda c: c.update(values)}


def images(**values):
    return {"preprocessor_config": lambda c: c.update(values)}


def action(**values):
    return {"config": lambda c: c["norm_stats"]["bridge_orig"]["action"].update(values)}


REFUSED = [
    (top(llm_backbone_id="vicuna-v15-7b"), "openvla-v01 has another prompt", Code.UNSUPPORTED),
    (top(llm_backbone_id="phi-2-3b"), "llm_backbone_id", Code.UNSUPPORTED),
    (top(use_fused_vision_backbone=False), "use_fused_vision_backbone", Code.UNSUPPORTED),
    (top(timm_model_ids=["vit_large_patch14_clip_336.openai"] * 2), "timm_model_ids", Code.UNSUPPORTED),
    (top(timm_override_act_layers=[None, "quick_gelu"]), "timm_override_act_layers", Code.UNSUPPORTED),
    (top(image_sizes=[28, 42]), "image_sizes", Code.UNSUPPORTED),
    (top(image_sizes=[30, 30]), "image_sizes: expected the same multiple of 14", Code.UNSUPPORTED),
    (top(image_sizes=[42, 42]), "input_sizes: expected twice 3 x 42 x 42", Code.UNSUPPORTED),
    (top(n_action_bins=409), "fewer bins than the 408 tokens", Code.BAD_BUNDLE),
    (top(n_action_bins=1), "n_action_bins", Code.BAD_BUNDLE),
    (top(pad_to_multiple_of=400), "fewer bins than the 72 tokens", Code.BAD_BUNDLE),
    (top(norm_stats={}), "norm_stats", Code.BAD_BUNDLE),
    (top(something="new"), "config.json: something", Code.UNSUPPORTED),
    (text(rope_scaling={"type": "linear", "factor": 2.0}), "rope_scaling", Code.UNSUPPORTED),
    (text(model_type="mistral"), "text_config: model_type", Code.UNSUPPORTED),
    (text(tie_word_embeddings=True), "tie_word_embeddings", Code.UNSUPPORTED),
    (text(hidden_act="gelu"), "hidden_act", Code.UNSUPPORTED),
    (text(attention_bias=True), "attention_bias", Code.UNSUPPORTED),
    (text(head_dim=4), "head_dim", Code.UNSUPPORTED),
    (action(q99=[1.0] * 6), "q99", Code.BAD_BUNDLE),
    (action(q01=None), "q01", Code.BAD_BUNDLE),
    (action(mask=[True] * 6), "mask", Code.BAD_BUNDLE),
    (images(image_resize_strategy="letterbox"), "image_resize_strategy", Code.UNSUPPORTED),
    (images(interpolations=["bilinear", "bicubic"]), "interpolations", Code.UNSUPPORTED),
    (images(input_sizes=[[3, 224, 224]] * 2), "input_sizes", Code.UNSUPPORTED),
    (images(means=[[0.5] * 3]), "means", Code.BAD_BUNDLE),
    (images(stds=[[0.5] * 3, [0.5, 0.5, 0.0]]), "stds", Code.BAD_BUNDLE),
    (images(tvf_normalize_params=[{"mean": [0.5] * 3}] * 2), "tvf_normalize_params", Code.UNSUPPORTED),
    (images(tvf_normalize_params=[{"mean": [0.5] * 3, "std": [0.5] * 2}] * 2), "tvf_normalize_params: stds", Code.BAD_BUNDLE),
    (images(tvf_do_letterbox=True), "tvf_do_letterbox", Code.UNSUPPORTED),
    (images(tvf_resize_params=[]), "tvf_resize_params", Code.UNSUPPORTED),
    (images(new_key=1), "new_key", Code.UNSUPPORTED),
    ({"generation_config": lambda c: c.update(repetition_penalty=1.2)}, "repetition_penalty", Code.UNSUPPORTED),
    ({"tokenizer_config": lambda c: c.update(add_prefix_space=True)}, "add_prefix_space", Code.UNSUPPORTED),
    ({"tokenizer": lambda c: c.update(normalizer=None)}, "normalizer", Code.UNSUPPORTED),
    ({"tokenizer": lambda c: c["normalizer"]["normalizers"].pop(0)}, "a blank in front of every text", Code.UNSUPPORTED),
    ({"tokenizer": lambda c: c.update(post_processor=None)}, "add_bos_token", Code.BAD_BUNDLE),
]


@pytest.mark.parametrize("changes, part, code", REFUSED, ids=[str(i) + " " + part for i, (_, part, _) in enumerate(REFUSED)])
def test_what_is_not_understood_is_refused_by_name(converter, changes, part, code):
    error = converter.refusal(saved(**changes))
    assert part in str(error) and code in {problem.code for problem in error.problems}


def test_there_is_one_camera(converter):
    assert "one camera" in str(converter.refusal(saved(), views=["a", "b"]))
    keys = converter.bundle(views=["top"]).keys
    assert keys["observation.views"] == ["observation.images.top"] and keys["observation.states"] == []

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""TurboVLA: names against the reference's and the runtime's, its backbones' configs, its tokenizer, refusals."""

import json

import pytest

from configs import of_config, sizes_of
from goldens import turbovla
from goldens.files import write_json
from manifests import check_keys, check_parameters
from vla_cpp.convert.archs import Options
from vla_cpp.convert.archs.turbovla import mapping
from vla_cpp.convert.archs.turbovla.config import read_sizes

ARCH = "turbovla"
VIEWS = {"top": (33, 40), "wrist": (20, 24)}
SMALL = turbovla.Checkpoint(
    turbovla.vision(24, 1, 3, 20, 4, 2), turbovla.text(20, 1, 2, 28, 16), turbovla.policy(3, 8, 2, 12, (1, 1), 8, max_language_tokens=6), VIEWS, 2, 2
)
PUBLISHED = turbovla.published({"image": (256, 256), "wrist_image": (256, 256)})


def sizes_at(checkpoint, folder):
    """Of the same configs, with the tower known by its name."""
    write_json(folder / "config.json", checkpoint.config)
    language = {"model_type": "bert", "vocab_size": checkpoint.n_vocab} | checkpoint.text
    write_json(folder / "language_encoder/config.json", language)
    return sizes_of(read_sizes, of_config(checkpoint.config, folder=folder))


@pytest.mark.parametrize("checkpoint", [PUBLISHED, *(case.checkpoint for case in turbovla.CASES.values())])
def test_every_config_asks_for_the_tensors_of_the_reference(checkpoint, tmp_path):
    if checkpoint is not PUBLISHED:
        checkpoint.write(1, tmp_path)
    sizes = sizes_at(checkpoint, tmp_path)
    rows = [*mapping.weights(sizes), *mapping.dropped(sizes)]
    assert {row.source: row.stored for row in rows} == checkpoint.shapes()


def test_names_shapes_and_storage_are_those_that_the_runtime_declares(tmp_path):
    check_parameters("turbovla", mapping.weights(sizes_at(PUBLISHED, tmp_path)))


def test_sizes_at_the_published_config_are_those_of_the_runtimes_manifest(tmp_path):
    check_keys("turbovla", mapping.network_keys(sizes_at(PUBLISHED, tmp_path)))


def test_the_recipe_is_that_of_the_reference(planned):
    keys, made = planned()
    recipe = json.loads(keys["processor.recipe"])
    assert recipe["image"][0] == {"op": "resize", "width": 8, "height": 8, "filter": "torch_bilinear"}
    assert recipe["image"][1]["mean"] == [0.485, 0.456, 0.406] and recipe["image"][1]["std"] == [0.229, 0.224, 0.225]
    assert recipe["text"] == [{"op": "tokenize", "max_tokens": 6, "truncate": "right"}]
    assert [op["op"] for op in recipe["state"] + recipe["action"]] == ["normalize", "unnormalize"]
    assert keys["observation.min_views"] == 2 and set(made.statistics) == {f"stats.{f}.{s}" for f in ("action", "observation.state") for s in ("mean", "std")}


def test_the_tokenizer_puts_two_tokens_around_a_text(planned):
    keys, _ = planned()
    assert keys["tokenizer.kind"] == "wordpiece" and keys["tokenizer.normalization"] == "bert_uncased"
    assert [keys["tokenizer.tokens"][i] for i in (*keys["tokenizer.prefix_ids"], *keys["tokenizer.suffix_ids"], keys["tokenizer.unknown_id"])] == [
        "[CLS]",
        "[SEP]",
        "[UNK]",
    ]
    assert "tokenizer.merges" not in keys


def test_a_model_of_an_older_file_states_no_type(planned, folder):
    model = json.loads((folder / "language_encoder/tokenizer.json").read_text())["model"]
    keys, _ = planned("language_encoder/tokenizer.json", "model", {k: v for k, v in model.items() if k != "type"})
    assert keys["tokenizer.kind"] == "wordpiece"


def test_the_language_models_folder_is_given_or_inside(planned, folder):
    keys, _ = planned(without=["language_encoder"], options=Options(backbone=str(folder / "language_encoder")))
    assert keys["lm.d_model"] == 20


def test_without_the_language_models_config_the_option_is_named(refusal):
    assert "expected --backbone DIR, or language_encoder/ inside the checkpoint" in refusal(without=["language_encoder"])


def test_another_tower_needs_its_config(refusal):
    message = refusal(path="vision_backbone", value="facebook/dinov3-vith16plus-pretrain-lvd1689m", without=["vision_encoder"])
    assert "vision_backbone: expected facebook/dinov3-vits16-pretrain-lvd1689m or" in message


@pytest.mark.parametrize(
    ("file", "path", "value", "message"),
    [
        ("config.json", "feedforward_activation", "silu", "feedforward_activation: expected relu or gelu"),
        ("config.json", "n_heads", 3, "n_heads: expected a divisor of dim_model 8"),
        ("config.json", "image_size", 10, "image_size: expected a multiple of patch_size 4"),
        ("config.json", "max_language_tokens", 2, "max_language_tokens: expected a whole number from 3 to 16"),
        ("config.json", "max_language_tokens", 17, "max_language_tokens: expected a whole number from 3 to 16"),
        ("config.json", "n_obs_steps", 2, "n_obs_steps: expected 1"),
        ("config.json", "chunk_size", 2, "n_action_steps: expected at most chunk_size 2"),
        ("config.json", "gate", 1, "gate: expected a key of TurboVLAConfig"),
        ("config.json", "normalization_mapping/VISUAL", "MEAN_STD", "norm_map.VISUAL: expected MEAN_STD as in config.json"),
        ("config.json", "input_features/observation.velocity", {"type": "STATE", "shape": [2]}, "observation.velocity: expected cameras and"),
        ("config.json", "input_features/observation.state", {"type": "STATE", "shape": [2, 2]}, "observation.state: expected type STATE"),
        ("config.json", "input_features", {}, "input_features: expected a VISUAL feature or several"),
        ("vision_encoder/config.json", "use_gated_mlp", True, "use_gated_mlp: expected False"),
        ("vision_encoder/config.json", "key_bias", True, "key_bias: expected False"),
        ("vision_encoder/config.json", "model_type", "dinov2", "model_type: expected 'dinov3_vit'"),
        ("vision_encoder/config.json", "num_attention_heads", 4, "num_attention_heads: expected heads of a multiple of 4"),
        ("language_encoder/config.json", "model_type", "t5", "model_type: expected 'bert'"),
        ("language_encoder/config.json", "hidden_act", "relu", "hidden_act: expected 'gelu'"),
        ("language_encoder/config.json", "vocab_size", 50, "ids: expected ids below vocab_size 50"),
        ("language_encoder/tokenizer.json", "normalizer/lowercase", False, "normalizer: expected BertNormalizer with"),
        ("language_encoder/tokenizer.json", "pre_tokenizer", {"type": "Whitespace"}, "pre_tokenizer: expected BertPreTokenizer"),
        ("language_encoder/tokenizer.json", "model/continuing_subword_prefix", "@@", "continuing_subword_prefix: expected '##'"),
        ("language_encoder/tokenizer.json", "model/unk_token", "none", "unk_token: expected a token of the vocabulary"),
        ("language_encoder/tokenizer.json", "post_processor", {"type": "BertProcessing"}, "post_processor: expected a template of special tokens around"),
        ("language_encoder/tokenizer.json", "added_tokens/0/content", "a", "added_tokens: expected words that the model's vocabulary does not have"),
        ("language_encoder/tokenizer_config.json", "do_lower_case", False, "do_lower_case: expected True"),
    ],
)
def test_what_the_runtime_does_not_do_is_refused_by_name(refusal, file, path, value, message):
    assert message in refusal(file, path, value)

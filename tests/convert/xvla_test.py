# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""X-VLA: names against the reference's and the runtime's, both spellings of its backbone, domains, its tokenizer, refusals."""

import json
from dataclasses import replace

import numpy as np
import pytest

from configs import of_config, sizes_of
from goldens import xvla
from manifests import check_keys, check_parameters
from vla_cpp.convert.archs import Options, load
from vla_cpp.convert.archs.xvla import mapping
from vla_cpp.convert.archs.xvla.config import read_sizes
from vla_cpp.convert.checkpoint import open_checkpoint
from vla_cpp.convert.conversion import _pieces, convert_checkpoint
from vla_cpp.convert.embodiments import plan_robots
from vla_cpp.convert.errors import ConvertError, Problems

ARCH = "xvla"
VIEWS = {"top": (33, 40), "wrist": (20, 24)}
SMALL = xvla.Checkpoint(
    xvla.vision((8, 12), (1, 1), (2, 3), (2, 4), 2, 8),
    xvla.text(8, 1, 2, 12),
    xvla.policy(3, 2, 12, 1, 2, resize_imgs_with_padding=(16, 24), max_state_dim=20, tokenizer_max_length=7, normalization_mapping=xvla.MAPPING),
    VIEWS,
    d_state=20,
    domain=1,
)
PUBLISHED = xvla.published({"image": (256, 256), "image2": (256, 256), "image3": (256, 256)})


def sizes_at(checkpoint):
    return sizes_of(read_sizes, of_config(checkpoint.config, checkpoint.stored()))


@pytest.mark.parametrize("checkpoint", [PUBLISHED, *(case.checkpoint for case in xvla.CASES.values())])
def test_every_config_asks_for_the_tensors_of_the_reference(checkpoint):
    sizes = sizes_at(checkpoint)
    rows = [*mapping.weights(sizes), *(row for row in mapping.dropped(sizes) if not row.source.endswith("final_logits_bias"))]
    assert {row.source: row.stored for row in rows} == {name: shape for name, (_, shape) in checkpoint.stored().items()}


def test_names_shapes_and_storage_are_those_that_the_runtime_declares():
    check_parameters("xvla", mapping.weights(sizes_at(PUBLISHED)))


def test_sizes_at_the_published_config_are_those_of_the_runtimes_manifest():
    sizes = sizes_at(PUBLISHED)
    sizes.n_token, sizes.pad_token = 50, 1
    check_keys("xvla", mapping.network_keys(sizes))


def test_the_recipe_is_that_of_the_reference(planned):
    keys, made = planned()
    recipe = json.loads(keys["processor.recipe"])
    assert recipe["image"][0] == {
        **{"op": "letterbox", "width": 24, "height": 16, "filter": "bilinear", "antialias": False, "align": "bottom_right"},
        "fill": [0.485, 0.456, 0.406],
    }
    assert recipe["image"][1]["mean"] == [0.485, 0.456, 0.406] and recipe["image"][1]["std"] == [0.229, 0.224, 0.225]
    assert recipe["text"] == [{"op": "tokenize", "max_tokens": 7, "truncate": "right"}]
    assert [op["op"] for op in recipe["state"]] == ["normalize", "pad"]
    assert [op["op"] for op in recipe["action"]] == ["sigmoid", "unnormalize"] and recipe["action"][0]["columns"] == [9, 19]
    assert keys["observation.min_views"] == 1 and keys["policy.n_token"] == 7 and keys["policy.pad_token"] == 1
    assert set(made.statistics) == {f"stats.{f}.{s}" for f in ("action", "observation.state") for s in ("mean", "std")}


def test_the_tokenizer_puts_two_tokens_around_a_text(planned):
    keys, _ = planned()
    assert keys["tokenizer.kind"] == "byte_level_bpe"
    assert [keys["tokenizer.tokens"][i] for i in (*keys["tokenizer.prefix_ids"], *keys["tokenizer.suffix_ids"])] == ["<s>", "</s>"]


def test_text_that_the_preprocessor_does_not_pad_has_no_padding(planned):
    keys, _ = planned("policy_preprocessor.json", "steps/2/config/padding", "longest")
    assert keys["policy.n_token"] == 0


def test_frames_that_are_not_resized_have_the_size_of_the_features():
    same = {"type": "VISUAL", "shape": [3, 33, 40]}
    state = {"type": "STATE", "shape": [20]}
    features = {"observation.state": state, "observation.images.top": same, "observation.images.wrist": same}
    config = SMALL.config | {"resize_imgs_with_padding": None, "input_features": features}
    sizes = sizes_of(read_sizes, of_config(config))
    assert sizes.frame == (40, 33) and not sizes.resizes


def test_the_first_row_behind_two_is_that_of_the_first_position():
    row = next(row for row in mapping.weights(sizes_at(SMALL)) if row.target == "lm.position.weight")
    assert row.first == 2 and row.stored[0] == row.shape[0] + 2


def test_a_domains_matrix_and_a_convolution_come_as_they_are_multiplied(folder):
    checkpoint = open_checkpoint(str(folder), {})
    sizes = sizes_at(SMALL)
    sizes.domain = 1
    rows = {row.target: row for row in mapping.weights(sizes)}

    def of(target):
        row = rows[target]
        found = np.concatenate([part.ravel() for part in _pieces(checkpoint.tensors[row.source], row)]).reshape(row.shape)
        return found, np.concatenate([*checkpoint.tensors[row.source].chunks()]).reshape(row.stored)

    found, stored = of("action_in.weight")
    assert (found == stored[1].reshape(found.shape[::-1]).T).all()
    found, stored = of("vision.stage.1.embed.conv.weight")
    assert (found.reshape(12, 3, 3, 8) == np.moveaxis(stored, 1, -1)).all()
    found, stored = of("vision.stage.0.blk.0.channel.conv2.kernel")
    assert (found.reshape(3, 3, 8) == np.moveaxis(stored[:, 0], 0, -1)).all()


def test_the_domain_is_that_of_the_preprocessor_or_of_the_option(planned):
    rows = {row.target: row for row in planned()[1].weights}
    assert rows["action_in.weight"].pick == (0, 1)


def test_several_domains_share_all_but_their_layers(planned):
    keys, made = planned(options=Options(embodiment="all"))
    own = {row.target for row in made.weights if row.target.startswith("embodiment.")}
    layers = [f"{layer}.{part}" for layer in ("action_in", "action_out") for part in ("weight", "bias")]
    assert own == {f"embodiment.{i}.{name}" for i in range(3) for name in (*layers, "prompt.weight")}
    assert keys["embodiments"] == ["0", "1", "2"] and not any(name.startswith("embodiment.") for name in keys)


def test_without_proprioception_the_state_that_robots_send_is_taken_and_not_read(tmp_path):
    checkpoint = replace(xvla.CASES["xvla/long_text"].checkpoint, d_state=5)
    checkpoint.write(1, tmp_path / "policy")
    made = plan_robots(load(ARCH), open_checkpoint(str(tmp_path / "policy"), {}), Options(), Problems("test"))
    keys = {key.name: key.value for key in made.keys}
    assert keys["observation.states"] == ["observation.state"] and keys["observation.state_dims"] == [5]
    assert json.loads(keys["processor.recipe"])["state"] == [{"op": "drop"}]
    assert keys["policy.d_state"] == 0 and "stats.observation.state.mean" not in made.statistics


@pytest.mark.parametrize("domain", ["3", "-1", "01", "arm"])
def test_a_domain_that_there_is_none_of_is_refused(refusal, domain):
    message = refusal(options=Options(embodiment=domain))
    assert "--embodiment: expected the number of a domain, below num_domains 3, found " + domain in message


def test_a_checkpoint_without_processor_files_is_refused(refusal):
    message = refusal(without=["policy_preprocessor.json", "policy_postprocessor.json"])
    assert "policy_preprocessor.json: expected the file beside model.safetensors" in message


def test_the_tokenizers_folder_is_given_or_inside(planned, folder):
    keys, _ = planned(without=["tokenizer"], options=Options(backbone=str(folder / "tokenizer")))
    assert keys["tokenizer.kind"] == "byte_level_bpe"


def test_without_a_tokenizer_the_option_is_named(refusal):
    assert "expected --backbone DIR, or tokenizer/ inside the checkpoint" in refusal(without=["tokenizer"])


def test_a_space_of_which_the_state_has_another_width_is_refused():
    config = SMALL.config | {"action_mode": "so101_bimanual", "max_state_dim": 22}
    with pytest.raises(ConvertError, match="max_state_dim: expected 20, with use_proprio, for action_mode so101_bimanual"):
        sizes_of(read_sizes, of_config(config))


def test_a_float32_checkpoint_that_the_reference_rounds_is_rounded(planned):
    assert all(row.in_bf16 for row in planned("config.json", "dtype", "bfloat16")[1].weights)


@pytest.mark.parametrize(
    ("file", "path", "value", "message"),
    [
        ("config.json", "action_mode", "ee9d", "action_mode: expected ee6d or joint or"),
        ("config.json", "dtype", "float16", "dtype: expected float32 or bfloat16"),
        ("config.json", "num_heads", 5, "num_heads: expected a divisor of hidden_size 12"),
        ("config.json", "n_obs_steps", 2, "n_obs_steps: expected 1"),
        ("config.json", "chunk_size", 2, "n_action_steps: expected at most chunk_size 2"),
        ("config.json", "gate", 1, "gate: expected a key of XVLAConfig"),
        ("config.json", "domain_feature_key", "robot", "domain_feature_key: expected None"),
        ("config.json", "use_proprio", False, "max_state_dim: expected 20 or more, with use_proprio, for action_mode ee6d"),
        ("config.json", "max_state_dim", 19, "max_state_dim: expected at least the feature's width 20"),
        ("config.json", "resize_imgs_with_padding", [16], "resize_imgs_with_padding: expected (height, width)"),
        ("config.json", "resize_imgs_with_padding", None, "resize_imgs_with_padding: expected a size, or views of one size"),
        ("config.json", "num_image_views", 33, "num_image_views: expected a whole number from 1 to 32"),
        ("config.json", "normalization_mapping/VISUAL", "MEAN_STD", "norm_map.VISUAL: expected MEAN_STD as in config.json"),
        ("config.json", "florence_config/vision_config/qkv_bias", False, "qkv_bias: expected True"),
        ("config.json", "florence_config/vision_config/activation_function", "relu", "activation_function: expected 'gelu'"),
        ("config.json", "florence_config/vision_config/model_type", "swin", "model_type: expected davit or florence_vision"),
        ("config.json", "florence_config/vision_config/image_pos_embed", {"type": "sine"}, "image_pos_embed: expected type learned_abs_2d"),
        ("config.json", "florence_config/vision_config/image_feature_source", ["last_frame"], "image_feature_source: expected spatial_avg_pool"),
        ("config.json", "florence_config/vision_config/patch_padding", [0, 1], "patch_padding: expected half of an odd patch_size"),
        ("config.json", "florence_config/vision_config/num_groups", [3, 4], "num_groups: expected divisors of embed_dim"),
        ("config.json", "florence_config/vision_config/num_heads", [2], "embed_dim: expected lists of as many numbers as stages"),
        ("config.json", "florence_config/vision_config/depths", [1, 0], "depths: expected a list of numbers above 0"),
        ("config.json", "florence_config/vision_config/projection_dim", 9, "d_model: expected projection_dim 9"),
        ("config.json", "florence_config/text_config/model_type", "t5", "model_type: expected bart or florence2_language"),
        ("config.json", "florence_config/text_config/scale_embedding", True, "scale_embedding: expected False"),
        ("config.json", "florence_config/text_config/encoder_attention_heads", 3, "encoder_attention_heads: expected a divisor of d_model 8"),
        ("config.json", "florence_config/text_config/vocab_size", 50, "ids: expected ids below vocab_size 50"),
        ("policy_preprocessor.json", "steps/3/config/image_keys", ["a"], "xvla_image_to_float: image_keys: expected None"),
        ("policy_preprocessor.json", "steps/5/config/domain_id", 3, "domain_id: expected the number of a domain, below num_domains 3"),
        ("policy_preprocessor.json", "steps/2/config/padding_side", "left", "padding_side: expected 'right'"),
        ("policy_preprocessor.json", "steps/3", {"registry_name": "xvla_image_scale", "config": {}}, "steps[3]: expected one of"),
        ("policy_postprocessor.json", "steps/1", {"registry_name": "xvla_rotation_6d_to_axis_angle"}, "steps[1]: expected one of"),
        ("tokenizer/tokenizer.json", "post_processor/sep", ["<pad>", 1], "post_processor: expected <s> and </s> of tokenizer_config.json"),
        ("tokenizer/tokenizer.json", "post_processor/type", "BertProcessing", "post_processor: expected a template of special tokens around"),
        ("tokenizer/tokenizer_config.json", "pad_token", "<none>", "pad_token: expected a token"),
    ],
)
def test_what_the_runtime_does_not_do_is_refused_by_name(refusal, file, path, value, message):
    assert message in refusal(file, path, value)


@pytest.mark.parametrize("vendored", [False, True])
def test_missing_extra_and_misshapen_tensors_are_named_in_one_error(tmp_path, vendored):
    class Wrong(xvla.Checkpoint):
        def shapes(self):
            shapes = super().shapes()
            del shapes["model.transformer.norm.bias"]
            shapes["model.vlm.language_model.encoder.layers.7.fc1.weight"] = (3, 2)
            shapes["model.vlm.vision_tower.blocks.0.0.spatial_block.norm2.bias"] = (9,)
            return shapes

    fields = {name: getattr(SMALL, name) for name in SMALL.__dataclass_fields__} | {"vendored": vendored}
    Wrong(**fields).write(1, tmp_path / "policy")
    with pytest.raises(ConvertError) as caught:
        convert_checkpoint(str(tmp_path / "policy"), str(tmp_path / "out.gguf"), Options())
    message = str(caught.value)
    norm2 = "spatial_block.ffn.norm.bias" if vendored else "spatial_block.norm2.bias"
    for part in ("model.transformer.norm.bias: expected (12,), found none", "layers.7.fc1.weight: expected no such tensor", norm2 + ": expected (8,), found (9,)"):
        assert part in message
    assert not (tmp_path / "out.gguf").exists()

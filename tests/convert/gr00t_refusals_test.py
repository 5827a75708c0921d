# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What of GR00T N1.7 checkpoints is refused, or asked for."""

from pathlib import Path

import pytest

from tiny import REMOVED, changed, write_json
from tiny_gr00t import HORIZON, OTHER, TAG, TinyGr00t
from vla_cpp.convert.archs.gr00t.robot import NAMES
from vla_cpp.convert.errors import Code

@pytest.mark.parametrize("tag, found", [("", "none"), ("libero_sim", "libero_sim")])
def test_the_robot_is_asked_for_with_the_tags_and_cameras_that_there_are(converter, tag, found):
    error = converter.refusal(TinyGr00t(), embodiment=tag)
    assert error.code == Code.USAGE
    assert (
        "--embodiment: expected the tag of the robot, one of: " in error.message()
        and "found " + found in error.message()
    )
    assert "{} (cameras front, wrist); {} (cameras head)".format(TAG, OTHER) in error.message()


@pytest.mark.parametrize("size", ["40", "40x", "0x30", "40x30x3", "widexhigh", "40x9999"])
def test_a_camera_has_a_width_and_a_height(converter, size):
    error = converter.refusal(TinyGr00t(), embodiment=TAG, camera_size=size)
    assert "--camera-size: expected WIDTHxHEIGHT in pixels" in error.message() and error.code == Code.USAGE


@pytest.mark.parametrize("options", [dict(variant="r1"), dict(views=["a"]), dict(identity_stats=["action"])])
def test_options_of_other_layouts_are_refused(converter, options):
    assert "found one of GR00T" in converter.refusal(TinyGr00t(), embodiment=TAG, **options).message()


@pytest.mark.parametrize(
    "options, expected",
    [
        (dict(embodiment=TAG), "a checkpoint of several robots"),
        (dict(camera_size="40x30"), "a checkpoint of GR00T"),
        (dict(letterbox=True), "a checkpoint of GR00T"),
    ],
)
def test_options_of_gr00t_are_refused_for_other_layouts(converter, tiny, options, expected):
    error = converter.refusal(tiny, **options)
    assert f"expected {expected}" in error.message() and error.code == Code.USAGE


ARM = "robots/{}/".format(TAG)
STATS = "statistics/{}/".format(TAG)
UNSUPPORTED = {
    "config.json: use_alternate_vl_dit: expected True, found False": {"config/use_alternate_vl_dit": False},
    "config.json: exclude_state: expected False": {"config/exclude_state": True},
    "config.json: use_vlln: expected True": {"config/use_vlln": False},
    "config.json: add_pos_embed: expected True": {"config/add_pos_embed": False},
    "config.json: new_thing: expected a key that this converter knows": {"config/new_thing": 1},
    "diffusion_model_cfg: positional_embeddings: expected None, found no such key, which means 'sinusoidal'": {
        "config/diffusion_model_cfg/positional_embeddings": REMOVED
    },
    "diffusion_model_cfg: interleave_self_attention: expected True, found no such key, which means False": {
        "config/diffusion_model_cfg/interleave_self_attention": REMOVED
    },
    "diffusion_model_cfg: norm_eps: expected 1e-05": {"config/diffusion_model_cfg/norm_eps": 1e-6},
    "vl_self_attention_cfg: activation_fn: expected 'gelu-approximate'": {
        "config/vl_self_attention_cfg/activation_fn": "geglu"
    },
    "processor_config.json: processor_class: expected 'Gr00tN1d7Processor'": {
        "processor/processor_class": "Gr00tN1d6Processor"
    },
    "processor_config.json: use_albumentations: expected True": {"kwargs/use_albumentations": False},
    "processor_config.json: exclude_state: expected False": {"kwargs/exclude_state": True},
    "processor_config.json: new_thing: expected a key that this converter knows": {"kwargs/new_thing": 1},
    "processor_config.json: image_target_size: expected [side, side] or null": {"kwargs/image_target_size": [12, 16]},
    "arm.state: new_thing: expected a key that this converter knows": {ARM + "state/new_thing": 1},
    "rope_scaling: mrope_interleaved: expected True": {"backbone/text_config/rope_scaling/mrope_interleaved": False},
    "rope_scaling: rope_type: expected 'default'": {"backbone/text_config/rope_scaling/rope_type": "yarn"},
    "text_config: attention_bias: expected False": {"backbone/text_config/attention_bias": True},
    "vision_config: spatial_merge_size: expected 2": {"backbone/vision_config/spatial_merge_size": 3},
    "backbone config.json: model_type: expected 'qwen3_vl'": {"backbone/model_type": "qwen2_vl"},
    "preprocessor_config.json: image_mean: expected [0.5, 0.5, 0.5], found no such key, which means None": {"images/image_mean": REMOVED},
    "preprocessor_config.json: resample: expected 3": {"images/resample": 2},
    "preprocessor_config.json: new_thing: expected a key": {"images/new_thing": 1},
}
BAD = {
    "arm.video: delta_indices: expected rising numbers of steps from -1000 to 0, found [0, -15]": {
        ARM + "video/delta_indices": [0, -15]
    },
    "arm.state: delta_indices: expected rising numbers of steps from -1000 to 0, found [1]": {ARM + "state/delta_indices": [1]},
    "arm.state: delta_indices: expected state_history_length 1 moments, found 2": {ARM + "state/delta_indices": [-1, 0]},
    "arm.state: delta_indices: expected state_history_length 2 moments, found 1": {"config/state_history_length": 2},
    "config.json: select_layer: expected a whole number from 1": {"config/select_layer": -1},
    "config.json: backbone_embedding_dim: expected the language model's width 12": {
        "config/backbone_embedding_dim": 13
    },
    "config.json: input_embedding_dim: expected 6, the heads": {"config/input_embedding_dim": 8},
    "config.json: max_seq_len: expected a row for each of the 7": {"config/max_seq_len": HORIZON - 1},
    "diffusion_model_cfg: output_dim: expected hidden_size 5": {"config/diffusion_model_cfg/output_dim": 6},
    "vl_self_attention_cfg: num_attention_heads: expected heads": {
        "config/vl_self_attention_cfg/num_attention_heads": 5
    },
    "processor_config.json: max_state_dim: expected 11 as in config.json, found 12": {"kwargs/max_state_dim": 12},
    "processor_config.json: crop_fraction: expected a value, or null, found no such key": {
        "kwargs/crop_fraction": REMOVED
    },
    "processor_config.json: image_target_size: expected a size": {"kwargs/image_target_size": None},
    "processor_config.json: image_target_size: expected [side, side] or null": {"kwargs/image_target_size": [12, 12, 12], "kwargs/shortest_image_edge": 12},
    "processor_config.json: image_crop_size: expected a size within": {"kwargs/image_crop_size": [13, 13]},
    "processor_config.json: clip_outliers: expected true or false": {"kwargs/clip_outliers": "yes"},
    "arm.state: modality_keys: expected different names": {ARM + "state/modality_keys": ["x", "x"]},
    "arm.action: action_configs: expected a JSON object for each of 2 keys, found [{}]": {
        ARM + "action/action_configs": [{}]
    },
    "arm.action: action_configs: expected a JSON object for each of 2 keys, found ['x', {}]": {
        ARM + "action/action_configs": ["x", {}]
    },
    "video: modality_keys: expected cameras of different names": {
        ARM + "video/modality_keys": ["a", "observation.images.a"]
    },
    "arm.action: delta_indices: expected a list of steps": {ARM + "action/delta_indices": []},
    "statistics.json: arm: expected statistics, found none": {"statistics/" + TAG: REMOVED},
    "statistics.json: arm.state.x.q01: expected numbers, found none": {STATS + "state/x/q01": REMOVED},
    "statistics.json: arm.state.gripper: expected statistics of one shape, found (2,) and (1,)": {STATS + "state/gripper/q99": [1.0]},
    "statistics.json: arm.action.x.mean: expected as many numbers as q01: 1, found [0.0, 0.0]": {STATS + "action/x/mean": [0.0, 0.0]},
    "statistics.json: arm.state.x.std: expected numbers, found none": {
        ARM + "state/mean_std_embedding_keys": ["x"],
        STATS + "state/x/std": REMOVED,
    },
    "statistics.json: state: expected at most max_state_dim 11 numbers, found 12": {
        ARM + "state/sin_cos_embedding_keys": ["gripper"],
        "kwargs/apply_sincos_state_encoding": True,
        **{STATS + "state/gripper/" + name: [0.0] * 5 for name in NAMES},
        **{STATS + "state/x/" + name: [0.0] * 2 for name in NAMES},
    },
    "statistics.json: arm.action.x.q99: expected numbers that float32 holds, found 1e+39": {STATS + "action/x/q99": [1e39]},
    "statistics.json: state: expected at most max_state_dim 11 numbers, found 13": {
        **{STATS + "state/gripper/" + name: [0.0] * 12 for name in NAMES},
    },
    "embodiment_id.json: arm: expected an index below max_num_embodiments 3, found 3": {"embodiments/" + TAG: 3},
    "embodiment_id.json: arm: expected an index below max_num_embodiments 3, found None": {
        "embodiments/" + TAG: REMOVED
    },
    "text_config: num_attention_heads: expected heads": {"backbone/text_config/num_key_value_heads": 3},
    "rope_scaling: mrope_section: expected three counts": {
        "backbone/text_config/rope_scaling/mrope_section": [1, 1, 2]
    },
    "vision_config: deepstack_visual_indexes: expected rising": {
        "backbone/vision_config/deepstack_visual_indexes": [0, 1, 2]
    },
    "vision_config: num_position_embeddings: expected a square": {"backbone/vision_config/num_position_embeddings": 10},
    "vision_config: out_hidden_size: expected the language": {"backbone/vision_config/out_hidden_size": 13},
    "backbone config.json: image_token_id: expected 266": {"backbone/image_token_id": 1},
    "max_position_embeddings: expected room for 2 views of 9 tokens": {
        "backbone/text_config/max_position_embeddings": 30
    },
    "preprocessor_config.json: patch_size: expected 2 as in": {"images/patch_size": 3},
    "preprocessor_config.json: size: expected shortest_edge": {"images/size": {"height": 12, "width": 12}},
}


@pytest.mark.parametrize("message", [*UNSUPPORTED, *BAD])
def test_what_changes_numbers_is_refused_by_name(converter, message):
    tiny = changed(TinyGr00t(), UNSUPPORTED.get(message) or BAD[message])
    error = converter.refusal(tiny, embodiment=TAG)
    assert message in error.message()
    assert error.code == (Code.UNSUPPORTED if message in UNSUPPORTED else Code.BAD_BUNDLE)


@pytest.mark.parametrize(
    "how, message",
    [
        (dict(type="EEF", format="XYZ_ROT6D"), "(x): format: expected a key of 9 numbers, found XYZ_ROT6D of 1"),
        (dict(type="EEF", format="DEFAULT"), "(x): format: expected XYZ_ROT6D or XYZ_ROTVEC, found 'DEFAULT'"),
        (dict(type="WHEEL"), "(x): type: expected EEF or NON_EEF, found 'WHEEL'"),
        (dict(format="XYZ_ROT6D"), "(x): format: expected DEFAULT, since the type is NON_EEF"),
        (dict(state_key=["x"]), "(x): state_key: expected a state of 1 numbers, found none"),
        (dict(state_key="nobody"), "(x): state_key: expected a state of 1 numbers, found none"),
        (dict(state_key="gripper"), "(x): state_key: expected a state of 1 numbers, found 2 numbers"),
    ],
)
def test_relative_actions_that_the_recipe_cannot_hold_are_refused(converter, how, message):
    assert message in converter.refusal(TinyGr00t().relative(**how), embodiment=TAG).message()


@pytest.mark.parametrize(
    "low, high, message",
    [
        ([[-1.0]] * 3, [[1.0]] * 3, "relative_action.x.min: expected a row for each of 4 actions, found 3 rows"),
        ([[-1.0]] * 4, [1.0], "relative_action.x: expected statistics of one shape, found (4, 1) and (1,)"),
        ([[-1.0], []] * 2, [[1.0]] * 4, "relative_action.x.min: expected numbers, found [[-1.0], []"),
        ([[-1.0, 0.0]] * 4, [[1.0, 2.0]] * 4, "relative_action.x: expected 1 numbers, found 2"),
        ([[-1.0]] * 4, [[1e39]] * 4, "relative_action.x.max: expected numbers that float32 holds, found 1e+39"),
    ],
)
def test_statistics_for_each_row_that_do_not_fit_are_refused(converter, low, high, message):
    tiny = TinyGr00t().relative()
    tiny.statistics[TAG]["relative_action"]["x"] = {"min": low, "max": high}
    assert message in converter.refusal(tiny, embodiment=TAG).message()


def test_missing_extra_and_misplaced_tensors_are_refused(converter):
    tiny = TinyGr00t()
    tiny.tensors["action_head.more"] = tiny.tensors.pop("action_head.vlln.weight")
    message = converter.refusal(tiny, embodiment=TAG).message()
    assert "tensor action_head.vlln.weight: expected (12,), found none" in message
    assert "tensor action_head.more: expected no such tensor" in message
    index = {"weight_map": dict.fromkeys(TinyGr00t().tensors, "model-00001-of-00002.safetensors")}
    converter.save(TinyGr00t())
    write_json(str(converter.folder / "model.safetensors.index.json"), index)
    assert "as model.safetensors.index.json says, found none" in converter.refusal(embodiment=TAG).message()


def test_layers_that_the_config_leaves_out_are_told_apart_from_strangers(converter):
    tiny = TinyGr00t()
    del tiny.config["vl_self_attention_cfg"]
    assert "vl_self_attention_cfg of config.json has 0 layers" in converter.refusal(tiny, embodiment=TAG).message()
    tiny, layer = TinyGr00t(), "backbone.model.model.language_model.layers.{}.input_layernorm.weight"
    tiny.tensors[layer.format(2)] = tiny.tensors[layer.format(1)]
    assert "select_layer keeps 2 language layers, 0 to 1" in converter.refusal(tiny, embodiment=TAG).message()


@pytest.mark.parametrize("name", ["processor_config.json", "statistics.json", "embodiment_id.json"])
def test_the_processors_files_are_needed_once(converter, name):
    converter.save(TinyGr00t())
    (converter.folder / "processor").mkdir()
    (converter.folder / "processor" / name).write_text("{}")
    assert name + " once, found " in converter.refusal(embodiment=TAG).message()
    (converter.folder / "processor" / name).unlink()
    (converter.folder / name).unlink()
    error = converter.refusal(embodiment=TAG)
    assert "below processor/" in error.message() and error.code == Code.IO


def test_the_backbones_image_processor_is_needed(converter):
    tiny = TinyGr00t()
    tiny.images = None
    assert converter.refusal(tiny, embodiment=TAG).code == Code.IO


TURNS = (Path(__file__).resolve().parents[1] / "golden/tokenizers/gr00t/chat_template.jinja").read_text()


@pytest.mark.parametrize(
    "template",
    [
        "{{ text }}",
        "<|im_start|>system\nYou are terse.<|im_end|>\n" + TURNS,
        TURNS.replace("{{ part.text }}", "{{ part.text | trim }}"),
        TURNS.replace("<|image_pad|>", "Picture: <|image_pad|>"),
        TURNS.replace("<|im_start|>assistant", "<|im_start|>assistant\n<think>"),
        "{{ bos_token }}" + TURNS,
        "{% for i in range(1000000000) %} {% endfor %}" + TURNS,
        "{% if %}",
    ],
)
def test_a_template_that_makes_another_prompt_is_refused(converter, template):
    tiny = TinyGr00t()
    tiny.template = template
    assert "chat_template.jinja: expected Qwen3-VL's" in converter.refusal(tiny, embodiment=TAG).message()


def test_a_template_in_other_words_that_makes_the_same_prompt_is_taken(converter):
    tiny = TinyGr00t()
    tiny.template = "{%- set n = namespace(value=0) %}{%- if tools %}{{ raise_exception('none') }}{% endif %}" + TURNS
    assert converter.bundle(tiny, embodiment=TAG).keys["vla.arch"] == "gr00t_n1_7"


@pytest.mark.parametrize(
    "change, message",
    [
        (dict(lstrip=True), "added token <|vision_start|>: expected a token that takes no blanks"),
        (dict(content="use"), "added token 'use': expected no added token within the prompt's own words"),
    ],
)
def test_added_tokens_that_would_move_the_views_are_refused(converter, change, message):
    tiny = TinyGr00t()
    tiny.tokenizer["added_tokens"][3 if "lstrip" in change else 0].update(change)
    tiny.tokenizer_config = {"tokenizer_class": "TokenizersBackend"}
    assert message in converter.refusal(tiny, embodiment=TAG).message()


@pytest.mark.parametrize(
    "config, message",
    [
        ({"type": "groot"}, "expected LeRobot's pipelines, found none"),
        ({"model_type": "Gr00tN1d8"}, "Gr00tN1d7, found Gr00tN1d8"),
    ],
)
def test_other_releases_and_layouts_of_gr00t_are_refused_by_name(converter, config, message):
    tiny = TinyGr00t()
    tiny.config = config
    error = converter.refusal(tiny)
    assert message in error.message() and error.code == Code.UNSUPPORTED

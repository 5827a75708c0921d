# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What the converter refuses of what a checkpoint says, and that each refusal says where, what and what next."""

import numpy as np
import pytest

from tiny import EXPERT, STATE_DIM, VLM, Tiny, write_json
from vla_cpp.convert import Code, archs


def set_in(path, value):
    """A change of one value, e.g. set_in("config.num_steps", 0); list indices are numbers."""

    def change(tiny):
        first, *rest = path.split(".")
        target = getattr(tiny, first)
        for key in rest[:-1]:
            target = target[int(key) if isinstance(target, list) else key]
        target[int(rest[-1]) if isinstance(target, list) else rest[-1]] = value

    return change


def config(**values):
    return lambda tiny: tiny.config.update(values)


def step(name, **values):
    return lambda tiny: tiny.step(name)["config"].update(values)


def text(**values):
    return lambda tiny: tiny.backbone["text_config"].update(values)


def vision(**values):
    return lambda tiny: tiny.backbone["vision_config"].update(values)


UNSUPPORTED, BAD = Code.UNSUPPORTED, Code.BAD_BUNDLE
ARCHS = ", ".join(archs.names())
CASES = {  # what the message must contain: (change, class)
    "config.json: type: expected one of " + ARCHS + ", found pi9": (config(type="pi9"), UNSUPPORTED),
    "config.json: type: expected one of " + ARCHS + ", found ['smolvla']": (config(type=["smolvla"]), UNSUPPORTED),
    "config.json: temperature: expected a key of SmolVLAConfig": (config(temperature=2.0), UNSUPPORTED),
    "config.json: add_image_special_tokens: expected False, found True": (
        config(add_image_special_tokens=True),
        UNSUPPORTED,
    ),
    "config.json: adapt_to_pi_aloha: expected False, found True": (config(adapt_to_pi_aloha=True), UNSUPPORTED),
    "config.json: use_cache: expected True, found False": (config(use_cache=False), UNSUPPORTED),
    "config.json: n_obs_steps: expected 1, found 2": (config(n_obs_steps=2), UNSUPPORTED),
    "config.json: rtc_config: expected none": (config(rtc_config={"execution_horizon": 0}), BAD),
    "resize_imgs_with_padding: expected a square, found 16 x 32": (
        config(resize_imgs_with_padding=[16, 32]),
        UNSUPPORTED,
    ),
    "resize_imgs_with_padding: expected [width, height], found null": (
        config(resize_imgs_with_padding=None),
        UNSUPPORTED,
    ),
    "a multiple of patch_size * scale_factor = 8, found 20": (config(resize_imgs_with_padding=[20, 20]), UNSUPPORTED),
    "config.json: num_steps: expected a whole number from 1": (config(num_steps=0), BAD),
    "config.json: chunk_size: expected a whole number": (config(chunk_size=2.5), BAD),
    "config.json: n_action_steps: expected at most chunk_size 6": (config(n_action_steps=7), BAD),
    "config.json: empty_cameras: expected a whole number from 0 to 64, found None": (config(empty_cameras=None), BAD),
    "norm_map.VISUAL: expected MEAN_STD as in config.json, found IDENTITY": (
        config(normalization_mapping={"VISUAL": "MEAN_STD", "STATE": "MEAN_STD", "ACTION": "MEAN_STD"}),
        BAD,
    ),
    "config.json: min_period: expected a number above 0.0": (config(min_period=-1), BAD),
    "config.json: max_state_dim: expected at least the feature's width 3": (config(max_state_dim=2), BAD),
    "config.json: max_action_dim: expected at least the feature's width 2": (config(max_action_dim=1), BAD),
    "an even expert width, for the time embedding, found 12 * 0.6 = 7": (config(expert_width_multiplier=0.6), BAD),
    "input_features.observation.state: expected type STATE": (
        lambda t: t.config["input_features"]["observation.state"].update(type="ENV"),
        BAD,
    ),
    "input_features.observation.images.top: expected a frame": (
        set_in("config.input_features", {"observation.images.top": {"type": "VISUAL", "shape": [12, 16]}}),
        BAD,
    ),
    "output_features.action: expected type ACTION": (config(output_features={}), BAD),
    "input_features: expected a VISUAL feature": (
        config(input_features={"observation.state": {"type": "STATE", "shape": [3]}}),
        BAD,
    ),
    "vision_config: hidden_act: expected 'gelu_pytorch_tanh', found 'gelu'": (vision(hidden_act="gelu"), UNSUPPORTED),
    "vision_config: num_channels: expected 3, found 4": (vision(num_channels=4), UNSUPPORTED),
    "vision_config: dtype: expected float32 or bfloat16, found 'float16'": (vision(dtype="float16"), UNSUPPORTED),
    "vision_config: num_attention_heads: expected a divisor": (vision(num_attention_heads=3), BAD),
    "vision_config: num_hidden_layers: expected a whole number from 1 to 1024": (vision(num_hidden_layers=10**9), BAD),
    "text_config: hidden_act: expected 'silu', found 'gelu'": (text(hidden_act="gelu"), UNSUPPORTED),
    "text_config: attention_bias: expected False, found True": (text(attention_bias=True), UNSUPPORTED),
    "text_config: mlp_bias: expected False, found True": (text(mlp_bias=True), UNSUPPORTED),
    "text_config: model_type: expected 'llama', found 'qwen2'": (text(model_type="qwen2"), UNSUPPORTED),
    "text_config: num_key_value_heads: expected a divisor": (text(num_key_value_heads=2), BAD),
    "text_config: head_dim: expected an even number": (text(head_dim=5), BAD),
    "backbone config.json: model_type: expected 'smolvlm', found 'siglip'": (
        set_in("backbone.model_type", "siglip"),
        UNSUPPORTED,
    ),
    "policy_preprocessor.json: steps[1]: expected one of": (
        set_in("pre.steps.1.registry_name", "delta_processor"),
        UNSUPPORTED,
    ),
    "policy_preprocessor.json: extra: expected name and steps only": (set_in("pre.extra", 1), UNSUPPORTED),
    "to_batch_processor: twist: expected no such field": (step("to_batch_processor", twist=1), UNSUPPORTED),
    "tokenizer_processor: truncation: expected True, found False": (
        step("tokenizer_processor", truncation=False),
        UNSUPPORTED,
    ),
    "tokenizer_processor: padding_side: expected 'right', found 'left'": (
        step("tokenizer_processor", padding_side="left"),
        UNSUPPORTED,
    ),
    "tokenizer_processor: task_key: expected 'task', found 'goal'": (
        step("tokenizer_processor", task_key="goal"),
        UNSUPPORTED,
    ),
    "tokenizer_processor: max_length: expected a count of tokens from 1 to 65536, found 0": (
        step("tokenizer_processor", max_length=0),
        BAD,
    ),
    "float_dtype: expected None or 'float32' or 'float', found 'bfloat16'": (
        step("device_processor", float_dtype="bfloat16"),
        UNSUPPORTED,
    ),
    "normalize_observation_keys: expected observation.state among them": (
        step("normalizer_processor", normalize_observation_keys=["x"]),
        UNSUPPORTED,
    ),
    "normalize_observation_keys: expected observation.state among them, found []": (
        step("normalizer_processor", normalize_observation_keys=[]),
        UNSUPPORTED,
    ),
    "features.observation.state: expected STATE of [3]": (step("normalizer_processor", features={}), BAD),
    "norm_map.VISUAL: expected IDENTITY, found MEAN_STD": (
        lambda t: t.normalization("MEAN_STD", "VISUAL"),
        UNSUPPORTED,
    ),
    "norm_map.STATE: expected MEAN_STD as in config.json, found MIN_MAX": (
        set_in("pre.steps.5.config.norm_map", {"STATE": "MIN_MAX"}),
        BAD,
    ),
    "normalization of action: expected IDENTITY or MEAN_STD": (
        lambda t: t.normalization("RANK", "ACTION"),
        UNSUPPORTED,
    ),
    "normalizer_processor: state_file: expected a file beside the JSON": (
        set_in("pre.steps.5.state_file", "../pre.safetensors"),
        BAD,
    ),
    "normalizer_processor: eps: expected a small number": (step("normalizer_processor", eps="tiny"), BAD),
    "policy_postprocessor.json: steps: expected a step unnormalizer_processor": (lambda t: t.post["steps"].pop(0), BAD),
    "policy_preprocessor.json: steps: expected a step tokenizer_processor": (lambda t: t.pre["steps"].pop(3), BAD),
    "smolvla_new_line_processor: expected the newline before tokenization": (
        lambda t: t.pre["steps"].insert(5, t.pre["steps"].pop(2)),
        UNSUPPORTED,
    ),
    "normalizer_processor: expected the step once": (lambda t: t.pre["steps"].append(t.pre["steps"][5]), UNSUPPORTED),
    "rename_map: expected renamings of views, found joints -> observation.state": (
        step("rename_observations_processor", rename_map={"joints": "observation.state"}),
        UNSUPPORTED,
    ),
    "rename_map: expected one other name per view": (
        step(
            "rename_observations_processor",
            rename_map={
                "observation.images.top": "observation.images.wrist",
                "observation.images.wrist": "observation.images.top",
            },
        ),
        UNSUPPORTED,
    ),
    "statistics of action: std: expected 2 numbers for MEAN_STD, found none (there are some for action, observation.state)": (
        lambda t: t.stats.pop("action.std"),
        BAD,
    ),
    "statistics of observation.state: mean: expected shape (3,), found (2,)": (
        lambda t: t.stats.update({"observation.state.mean": np.ones(2, np.float32)}),
        BAD,
    ),
    "statistics of action: mean: expected finite numbers, found inf": (
        lambda t: t.stats["action.mean"].fill(np.inf),
        BAD,
    ),
    "statistics of action: std: expected numbers >= 0": (lambda t: t.stats["action.std"].fill(-1), BAD),
    "tensor model.state_proj.weight: expected finite numbers, found NaN or infinity": (
        lambda t: t.tensors["model.state_proj.weight"].fill(np.nan),
        BAD,
    ),
}


@pytest.mark.parametrize("message", CASES)
def test_it_is_refused_with_place_expectation_and_class(converter, tiny, message):
    change, code = CASES[message]
    change(tiny)
    error = converter.refusal(tiny)
    assert message in error.message()
    assert error.code == code


def test_every_missing_extra_and_misshapen_tensor_is_named_at_once(converter, tiny):
    del tiny.tensors["model.action_in_proj.bias"]
    del tiny.tensors[EXPERT + "norm.weight"]
    tiny.tensors["model.extra.weight"] = np.ones((2, 3), np.float32)
    tiny.tensors[VLM + "text_model.layers.2.input_layernorm.weight"] = np.ones(12, np.float32)
    tiny.tensors["model.state_proj.weight"] = tiny.tensors["model.state_proj.weight"].T.copy()
    error = converter.refusal(tiny)
    assert error.message().splitlines() == [
        "policy: 5 problems",
        "  tensor model.action_in_proj.bias: expected (6,), found none",
        "  tensor model.extra.weight: expected no such tensor, found F32 (2, 3); no part of this policy reads it",
        "  tensor model.state_proj.weight: expected (12, 4), found (4, 12)",
        "  tensor {}norm.weight: expected (6,), found none".format(EXPERT),
        "  tensor {}text_model.layers.2.input_layernorm.weight: expected no such tensor, found F32 (12,); num_vlm_layers is 2: text layers are 0 to 1".format(
            VLM
        ),
    ]


def test_a_square_matrix_of_another_width_is_refused_because_shapes_come_from_the_config(converter, tiny):
    name = EXPERT + "layers.1.self_attn.k_proj.weight"
    tiny.tensors[name] = np.ones((4, 6), np.float32)
    assert converter.refusal(tiny).message() == "tensor {}: expected (4, 4), found (4, 6)".format(name)


def test_a_misshapen_tensor_that_would_be_dropped_is_refused_too(converter, tiny):
    tiny.tensors["model.vlm_with_expert.vlm.lm_head.weight"] = np.ones((2, 2), np.float32)
    assert "lm_head.weight: expected (300, 12), found (2, 2)" in converter.refusal(tiny).message()


def test_weights_in_double_precision_are_refused_by_name(converter, tiny):
    tiny.tensors["model.state_proj.bias"] = tiny.tensors["model.state_proj.bias"].astype(np.float64)
    assert "tensor model.state_proj.bias: expected F32 or F16 or BF16, found F64" in converter.refusal(tiny).message()


def test_all_problems_of_configs_and_processors_arrive_in_one_report(converter, tiny):
    for message in (
        "config.json: num_steps: expected a whole number from 1",
        "text_config: attention_bias: expected False, found True",
    ):
        CASES[message][0](tiny)
    assert len(converter.refusal(tiny).problems) == 2
    other = Tiny()
    for message in (
        "statistics of action: std: expected numbers >= 0",
        "tokenizer_processor: truncation: expected True, found False",
    ):
        CASES[message][0](other)
    assert len(converter.refusal(other).problems) == 2


def test_f16_overflow_is_refused_by_tensor_name(converter, tiny):
    tiny.tensors["model.action_out_proj.weight"][1, 2] = 70000.0
    tiny.tensors["model.state_proj.weight"][0, 0] = -1e6
    error = converter.refusal(tiny, dtype="f16")
    assert [problem.where for problem in error.problems] == [
        "tensor model.state_proj.weight (state_in.weight)",
        "tensor model.action_out_proj.weight (action_out.weight)",
    ]
    assert "use --dtype bf16 or f32" in error.message()


def test_statistics_of_other_features_are_named_when_the_policys_are_missing(converter, tiny):
    tiny.stats = {"so100.buffer.action.mean": np.ones(2, np.float32)}
    assert "found none (there are some for so100.buffer.action)" in converter.refusal(tiny).message()


def test_identity_for_a_feature_that_the_policy_does_not_have_is_refused(converter, tiny):
    assert (
        "--identity-stats: expected observation.state or action, found joints"
        in converter.refusal(tiny, identity_stats=["joints"]).message()
    )


def test_identity_does_not_silence_statistics_that_are_present_but_wrong(converter, tiny):
    tiny.stats["action.mean"] = np.full(2, np.inf, np.float32)
    assert "expected finite numbers" in converter.refusal(tiny, identity_stats=["action"]).message()


def test_uninitialised_statistics_of_the_older_layout_are_refused(converter, tiny):
    tiny.stats["action.std"] = np.full(2, np.inf, np.float32)
    assert (
        "statistics of action: std: expected finite numbers, found inf"
        in converter.refusal(tiny.old_layout()).message()
    )


def test_groups_of_the_older_layout_that_disagree_are_refused(converter, tiny):
    tiny.old_layout().tensors["unnormalize_outputs.buffer_action.mean"] = np.full(2, 9, np.float32)
    assert (
        "tensor unnormalize_outputs.buffer_action.mean: expected the numbers that another group has"
        in converter.refusal(tiny).message()
    )


def test_two_names_that_a_compiled_policy_folds_into_one_are_refused(converter, tiny):
    tiny.tensors["model._orig_mod.state_proj.bias"] = tiny.tensors["model.state_proj.bias"]
    assert "tensor model.state_proj.bias: expected one tensor of this name" in converter.refusal(tiny).message()


def test_names_of_a_data_set_with_other_widths_are_refused(converter, tiny, tmp_path):
    write_json(str(tmp_path / "info.json"), {"fps": 10, "features": {"observation.state": {"names": ["a", "b"]}}})
    message = converter.refusal(tiny, dataset_info=str(tmp_path / "info.json")).message()
    assert "features.observation.state.names: expected {} different names".format(STATE_DIM) in message


@pytest.mark.parametrize(
    "info, place",
    [
        ({"anything": 1}, "features: expected observation.state and action, found none"),
        ({"features": {"observation.images.top": {}}}, "features: expected observation.state and action, found observation.images.top"),
        ({"features": {"action": {"shape": [14]}}}, "features.action.shape: expected [2], found [14]"),
    ],
)
def test_a_file_that_is_no_info_of_this_robot_is_refused(converter, tiny, tmp_path, info, place):
    write_json(str(tmp_path / "info.json"), info)
    assert place in converter.refusal(tiny, dataset_info=str(tmp_path / "info.json")).message()

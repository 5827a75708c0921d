# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What of Evo-1 checkpoints is refused, or asked for."""

import numpy as np
import pytest

from tiny import REMOVED, changed
from tiny_evo1 import ANSWERS, ARM, DATASET, N_LAYER, STATE_DIM, TinyEvo1, TinyEvo1Lerobot
from vla_cpp.convert.errors import Code


def test_everything_that_the_authors_checkpoint_leaves_open_is_asked_for_at_once(converter):
    tiny = TinyEvo1()
    tiny.norm_stats[ARM]["another"] = tiny.stats
    error = converter.refusal(tiny)
    assert error.code == Code.USAGE and len(error.problems) == 5
    for flag in ("--stats", "--variant", "--views", "--max-views", "--masked-rows"):
        problem = next(p for p in error.problems if p.where == flag)
        assert problem.found == "none" and "docs/converting.md" in problem.hint and len(problem.hint) > 60
    assert "{0}/{1}, {0}/another".format(ARM, DATASET) in error.message()


ANSWERS_THAT_DO_NOT_FIT = {
    "--variant: expected r1 or r2, a revision of the authors' code, found pi0_libero": dict(variant="pi0_libero"),
    "--views: expected different names, no more than there are slots, found a,a": dict(views=["a", "a"]),
    "--views: expected different names, no more than there are slots, found a,": dict(views=["a", ""]),
    "--views: expected different names, no more than there are slots, found a,observation": dict(
        views=["a", "observation.images.a"]
    ),
    "--views: expected different names, no more than there are slots, found a,b,c,d": dict(views=list("abcd")),
    "--max-views: expected a count from 1 to 32, found -1": dict(max_views=-1),
    "--masked-rows: expected zero_attention or causal_attention, found unseen": dict(masked_rows="unseen"),
    "--stats: expected one of the entries": dict(stats="nobody/nothing"),
    "--identity-stats: expected a checkpoint of LeRobot, found one of Evo-1's authors": dict(identity_stats=["action"]),
    "--position-precision: expected a checkpoint of LeRobot": dict(position_precision="float32"),
}


@pytest.mark.parametrize("message", ANSWERS_THAT_DO_NOT_FIT)
def test_an_answer_that_does_not_fit_is_refused(converter, message):
    error = converter.refusal(TinyEvo1(), **{**ANSWERS, **ANSWERS_THAT_DO_NOT_FIT[message]})
    assert message in error.message() and error.code == Code.USAGE


@pytest.mark.parametrize("name, value", [*ANSWERS.items(), ("stats", "a/b"), ("position_precision", "float32")])
def test_answers_for_the_authors_layout_are_refused_for_lerobots(converter, name, value):
    error = converter.refusal(TinyEvo1Lerobot(), **{name: value})
    assert "--" + name.replace("_", "-") in error.message() and error.code == Code.USAGE


def authors(**changes):
    """A checkpoint of the authors with other values at paths of its attributes."""
    return changed(TinyEvo1(), changes, "__")


def lerobot(**changes):
    return changed(TinyEvo1Lerobot(), changes, "__")


AUTHORS = {
    "config.json: num_categories: expected 1, found 2": dict(config__num_categories=2),
    "config.json: return_cls_only: expected False": dict(config__return_cls_only=True),
    "config.json: action_head: expected 'flowmatching'": dict(config__action_head="diffusion"),
    "config.json: per_action_dim: expected 24, found no such key, which means 7": dict(config__per_action_dim=REMOVED),
    "config.json: state_dim: expected 24, found 8": dict(config__state_dim=8),
    "config.json: horizon: expected at least 2, found 1": dict(config__horizon=1),
    "config.json: action_horizon: expected horizon 4": dict(config__action_horizon=5),
    "config.json: embed_dim: expected the language model's width 12": dict(config__embed_dim=16),
    "config.json: num_heads: expected a divisor of embed_dim 12": dict(config__num_heads=5),
    "config.json: normalization_type: expected bounds or bounds_q99 or normal, found ['x']": dict(config__normalization_type=["x"]),
    "config.json: surprise: expected a key of EvoConfig": dict(config__surprise=1),
    "dims.json: surprise: expected language_layers or prompt_tokens": dict(dims__surprise=1),
    "dims.json: prompt_tokens: expected a whole number": dict(dims__prompt_tokens="many"),
    "prompt: expected room for 3 views of 4 tokens, found 20 tokens": dict(dims__prompt_tokens=20),
    "rope_scaling: expected none, or dynamic from 64 positions on": dict(dims__prompt_tokens=65),
    "llm_config: rope_scaling: expected none, or dynamic": dict(backbone__llm_config__rope_scaling={"type": "yarn"}),
    "backbone config.json: model_type: expected 'internvl_chat', found 'internvl'": dict(backbone__model_type="internvl"),
    "backbone config.json: select_layer: expected -1": dict(backbone__select_layer=-2),
    "backbone config.json: ps_version: expected 'v2', found no such key, which means 'v1'": dict(backbone__ps_version=REMOVED),
    "backbone config.json: downsample_ratio: expected 0.5": dict(backbone__downsample_ratio=0.25),
    "backbone config.json: use_llm_lora: expected 0": dict(backbone__use_llm_lora=16),
    "backbone config.json: force_image_size: expected 56": dict(backbone__force_image_size=448),
    "vision_config: norm_type: expected 'layer_norm', found no such key, which means 'rms_norm'": dict(
        backbone__vision_config__norm_type=REMOVED
    ),
    "vision_config: qk_normalization: expected False": dict(backbone__vision_config__qk_normalization=True),
    "vision_config: qkv_bias: expected True": dict(backbone__vision_config__qkv_bias=False),
    "vision_config: hidden_act: expected 'gelu'": dict(backbone__vision_config__hidden_act="gelu_new"),
    "vision_config: num_attention_heads: expected a divisor": dict(backbone__vision_config__num_attention_heads=4),
    "vision_config: image_size: expected a multiple of twice the patch size": dict(
        backbone__vision_config__image_size=70, backbone__force_image_size=70
    ),
    "llm_config: architectures: expected ['Qwen2ForCausalLM']": dict(backbone__llm_config__architectures=["LlamaForCausalLM"]),
    "llm_config: hidden_act: expected 'silu'": dict(backbone__llm_config__hidden_act="gelu"),
    "llm_config: use_sliding_window: expected False": dict(backbone__llm_config__use_sliding_window=True),
    "llm_config: head_dim: expected 4": dict(backbone__llm_config__head_dim=6),
    "llm_config: num_attention_heads: expected heads of an even width": dict(backbone__llm_config__num_attention_heads=4),
    "tokenizer_config.json: padding_side: expected 'right'": dict(tokenizer_config__padding_side="left"),
    "tokenizer_config.json: truncation_side: expected 'right'": dict(tokenizer_config__truncation_side="left"),
    "tokenizer_config.json: pad_token: expected one of the added tokens, found 'None'": dict(tokenizer_config__pad_token=REMOVED),
}


@pytest.mark.parametrize("message", AUTHORS)
def test_an_authors_checkpoint_is_refused_with_its_place(converter, message):
    assert message in converter.refusal(authors(**AUTHORS[message]), **ANSWERS).message()


STATISTICS = {
    "observation.state.min: expected 1 to 24 numbers, found none": ("min", None),
    "observation.state.min: expected 1 to 24 numbers, found 25 numbers": ("min", [0.0] * 25),
    "observation.state.min: expected 1 to 24 numbers, found str": ("min", "low"),
    "observation.state.min: expected finite numbers, found inf": ("min", [1e300] * STATE_DIM),
    "observation.state: expected lists of one length": ("min", [0.0] * (STATE_DIM - 1)),
}


@pytest.mark.parametrize("message", STATISTICS)
def test_statistics_that_cannot_be_meant_are_refused(converter, message):
    tiny = TinyEvo1()
    name, value = STATISTICS[message]
    tiny.stats["observation.state"][name] = value
    assert message in converter.refusal(tiny, **ANSWERS).message()


def test_a_negative_deviation_is_refused(converter):
    tiny = authors(config__normalization_type="normal")
    tiny.stats["action"]["std"][1] = -1.0
    assert "action.std: expected numbers >= 0, found -1.0" in converter.refusal(tiny, **ANSWERS).message()


def test_the_first_revision_knows_one_normalization(converter):
    error = converter.refusal(authors(config__normalization_type="normal"), **{**ANSWERS, "variant": "r1"})
    assert "the server of r1 knows no other" in error.message()


def test_a_folder_without_weights_names_the_files_that_it_may_have(converter):
    tiny = TinyEvo1()
    tiny.weights = ""
    error = converter.refusal(tiny, **ANSWERS)
    assert error.code == Code.IO and "either mp_rank_00_model_states.pt or checkpoint.pt, found no such file" in error.message()


def test_two_files_of_weights_are_refused(converter):
    tiny = TinyEvo1()
    folder = converter.save(tiny)
    tiny.weights, tiny.member = "checkpoint.pt", "model_state_dict"
    tiny.save(folder)
    assert "found both" in converter.refusal(**ANSWERS).message()


def test_missing_extra_and_misshapen_tensors_are_listed_together(converter):
    tiny = TinyEvo1()
    missing = "action_head.transformer_blocks.0.attn.in_proj_weight"
    del tiny.tensors[missing]
    tiny.tensors["embedder.model.vision_model.encoder.layers.0.attn.qkv.bias"] = np.zeros(7, "<u2")
    extra = "embedder.model.language_model.model.layers.{}.self_attn.q_proj.weight".format(N_LAYER)
    tiny.tensors[extra] = np.zeros((12, 12), "<u2")
    text = converter.refusal(tiny, **ANSWERS).message()
    assert "tensor {}: expected (36, 12), found none".format(missing) in text
    assert "attn.qkv.bias: expected (18,), found (7,)" in text
    assert "tensor {}: expected no such tensor".format(extra) in text and "keeps 2 language layers, 0 to 1" in text


LEROBOT = {
    "config.json: surprise: expected a key of Evo1Config": dict(config__surprise=1),
    "config.json: num_categories: expected 1": dict(config__num_categories=3),
    "config.json: return_cls_only: expected False": dict(config__return_cls_only=True),
    "config.json: horizon: expected at least 2": dict(config__chunk_size=1, config__n_action_steps=1),
    "config.json: n_action_steps: expected at most chunk_size 4": dict(config__n_action_steps=5),
    "config.json: max_views: expected at least the 2 cameras": dict(config__max_views=1),
    "config.json: max_state_dim: expected at least the feature's width 5": dict(config__max_state_dim=4),
    "config.json: postprocess_action_dim: expected at most the action's width 3": dict(config__postprocess_action_dim=4),
    "config.json: image_resolution: expected the tower's 56 x 56": dict(config__image_resolution=[448, 448]),
    "config.json: vlm_dtype: expected bfloat16 or float32": dict(config__vlm_dtype="float16"),
    "config.json: binarize_gripper: expected true or false": dict(config__binarize_gripper=1),
    "config.json: gripper_index: expected a column of the action, below 3": dict(config__gripper_index=6),
    "policy_postprocessor.json: gripper_threshold: expected 0.75 as config.json has it": dict(config__gripper_threshold=0.75),
    "config.json: rtc_config: expected none": dict(config__rtc_config={"execution_horizon": 0}),
    "backbone config.json: model_type: expected 'internvl', found 'internvl_chat'": dict(backbone__model_type="internvl_chat"),
    "backbone config.json: image_seq_length: expected 4, the tokens of a view": dict(backbone__image_seq_length=256),
    "backbone config.json: image_token_id: expected 266, the tokenizer's": dict(backbone__image_token_id=1),
    "backbone config.json: vision_feature_layer: expected -1": dict(backbone__vision_feature_layer=-2),
    "backbone config.json: projector_hidden_act: expected 'gelu'": dict(backbone__projector_hidden_act="relu"),
    "vision_config: attention_bias: expected True, found no such key, which means False": dict(
        backbone__vision_config__attention_bias=REMOVED
    ),
    "vision_config: use_qk_norm: expected False": dict(backbone__vision_config__use_qk_norm=True),
    "vision_config: use_mean_pooling: expected True": dict(backbone__vision_config__use_mean_pooling=False),
    "vision_config: patch_size: expected a whole number": dict(backbone__vision_config__patch_size=[14, 7]),
    "text_config: layer_types: expected full_attention only": dict(backbone__text_config__layer_types=["sliding_attention"]),
    "text_config: rope_parameters: expected none, or dynamic": dict(
        backbone__text_config__rope_parameters={"rope_type": "linear", "factor": 2.0}
    ),
}


@pytest.mark.parametrize("message", LEROBOT)
def test_a_lerobot_checkpoint_is_refused_with_its_place(converter, message):
    assert message in converter.refusal(lerobot(**LEROBOT[message])).message()


def test_padded_columns_that_become_different_numbers_are_refused(converter):
    tiny = TinyEvo1Lerobot()
    tiny.statistics["observation.state.max"][-1] = 3.0
    assert "expected statistics that make one number of all padded columns" in converter.refusal(tiny).message()


def test_statistics_narrower_than_the_robot_are_refused(converter):
    tiny = TinyEvo1Lerobot()
    tiny.statistics["observation.state.min"] = tiny.statistics["observation.state.min"][: STATE_DIM - 1]
    assert "observation.state: min: expected shape (5,) to (7,), found (4,)" in converter.refusal(tiny).message()


def test_the_older_layout_is_refused(converter):
    tiny = TinyEvo1Lerobot()
    tiny.pre = None
    assert "expected the pipelines of LeRobot" in converter.refusal(tiny).message()


@pytest.mark.parametrize(
    "message, pipeline, order",
    [
        ("evo1_pad_state_processor before normalization", "pre", [0, 1, 4, 2, 3, 5]),
        ("evo1_pad_state_processor before normalization", "pre", [0, 1, 3, 4, 5]),
        ("evo1_action_processor after un-normalization", "post", [1, 0, 2]),
    ],
)
def test_steps_in_another_order_are_refused(converter, message, pipeline, order):
    tiny = TinyEvo1Lerobot()
    steps = getattr(tiny, pipeline)["steps"]
    steps[:] = [steps[i] for i in order]
    assert message in converter.refusal(tiny).message()


def test_a_step_of_another_policy_is_refused(converter):
    tiny = TinyEvo1Lerobot()
    tiny.pre["steps"].insert(2, {"registry_name": "pi0_new_line_processor", "config": {}})
    assert "found pi0_new_line_processor" in converter.refusal(tiny).message()


def test_a_padding_step_of_another_width_contradicts_the_config(converter):
    tiny = TinyEvo1Lerobot()
    tiny.step("evo1_pad_state_processor")["config"]["max_state_dim"] = 9
    assert "max_state_dim: expected 7 as in config.json" in converter.refusal(tiny).message()


@pytest.mark.parametrize(
    "change, message",
    [
        (dict(lstrip=True), "added token <img>: expected a token that takes no blanks"),
        (dict(content="mage"), "added token 'mage': expected no added token within the prompt's own words"),
    ],
)
def test_added_tokens_that_would_move_the_views_are_refused(converter, change, message):
    tiny = TinyEvo1Lerobot()
    tiny.tokenizer["added_tokens"][3 if "lstrip" in change else 1].update(change)
    assert message in converter.refusal(tiny).message()

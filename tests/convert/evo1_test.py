# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Conversion of Evo-1 checkpoints of both layouts."""

import json

import numpy as np
import pytest

from goldens import files
from tiny_evo1 import (
    ACTION_DIM,
    ANSWERS,
    ARM,
    D_ACTION,
    D_MODEL,
    D_STATE,
    D_VISION,
    DATASET,
    FIRST_ADDED,
    HORIZON,
    N_LAYER,
    N_TOKEN,
    N_VIEW_TOKEN,
    PATCH,
    STATE_DIM,
    WIDTH,
    TinyEvo1,
    TinyEvo1Lerobot,
)
from vla_cpp.convert import read_bundle
from vla_cpp.convert.cli import main

STATE, ACTION = "stats.observation.state", "stats.action"


def f32(bits):
    return (bits.astype(np.uint32) << 16).view(np.float32)


def recipe(bundle):
    return json.loads(bundle.keys["processor.recipe"])


def authors(converter, tiny=None, **answers):
    return converter.bundle(tiny or TinyEvo1(), **{**ANSWERS, **answers})


def test_every_number_of_the_authors_tensors_is_in_the_bundle(converter):
    tiny = TinyEvo1()
    bundle = authors(converter, tiny)
    assert bundle.keys["vla.arch"] == "evo1" and bundle.keys["vla.dtype"] == "bf16"
    stored = sum(array.size for array in tiny.tensors.values())
    assert stored == sum(array.size for name, array in bundle.tensors.items() if not name.startswith("stats."))
    one = {
        "vision.class_token.weight": "embedder.model.vision_model.embeddings.class_embedding",
        "vision.position.weight": "embedder.model.vision_model.embeddings.position_embedding",
        "vision.patch_embed.weight": "embedder.model.vision_model.embeddings.patch_embedding.weight",
        "vision.blk.0.attn_norm.bias": "embedder.model.vision_model.encoder.layers.0.norm1.bias",
        "vision.blk.0.ffn_scale.weight": "embedder.model.vision_model.encoder.layers.0.ls2",
        "connector.norm.weight": "embedder.model.mlp1.0.weight",
        "connector.up.weight": "embedder.model.mlp1.1.weight",
        "connector.down.bias": "embedder.model.mlp1.3.bias",
        "lm.token_embd.weight": "embedder.model.language_model.model.embed_tokens.weight",
        "lm.blk.1.attn_k.bias": "embedder.model.language_model.model.layers.1.self_attn.k_proj.bias",
        "lm.norm.weight": "embedder.model.language_model.model.norm.weight",
        "state_out.weight": "action_head.state_encoder.fc2.linear.weight",
        "time.weight": "action_head.time_pos_enc.pe",
        "action_position.weight": "action_head.action_encoder.pos_encoding.pe",
        "action_token.bias": "action_head.action_encoder.W3.linear.bias",
        "head.blk.0.ffn_down.weight": "action_head.transformer_blocks.0.ff.2.weight",
        "pool.weight": "action_head.seq_pool_proj.weight",
        "velocity_out.weight": "action_head.mlp_head.fc2.linear.weight",
    }
    for target, source in one.items():
        found = bundle.tensors[target]
        found = f32(found) if bundle.dtypes[target] == "bf16" else found
        np.testing.assert_array_equal(found.ravel(), f32(tiny.tensors[source]).ravel(), err_msg=target)


@pytest.mark.parametrize(
    "target, source, d",
    [
        ("vision.blk.0", "embedder.model.vision_model.encoder.layers.0.attn.qkv.", D_VISION),
        ("head.blk.0", "action_head.transformer_blocks.0.attn.in_proj_", D_MODEL),
    ],
)
def test_stacked_projections_come_apart_in_thirds(converter, target, source, d):
    tiny = TinyEvo1()
    bundle = authors(converter, tiny)
    for i, part in enumerate(("attn_q", "attn_k", "attn_v")):
        weight, bias = (bundle.tensors["{}.{}.{}".format(target, part, kind)] for kind in ("weight", "bias"))
        np.testing.assert_array_equal(weight, tiny.tensors[source + "weight"][i * d : (i + 1) * d])
        np.testing.assert_array_equal(bias, f32(tiny.tensors[source + "bias"][i * d : (i + 1) * d]))


def test_shapes_are_those_of_the_runtime(converter):
    shapes = {name: array.shape for name, array in authors(converter).tensors.items()}
    assert shapes["vision.class_token.weight"] == (D_VISION,)
    assert shapes["vision.patch_embed.weight"] == (D_VISION, 3 * PATCH**2)
    assert shapes["vision.position.weight"] == (17, D_VISION)
    assert shapes["time.weight"] == (1000, D_MODEL) and shapes["action_position.weight"] == (HORIZON, D_MODEL)
    assert shapes["velocity_out.weight"][0] == HORIZON * WIDTH


def test_keys_of_the_authors_second_revision(converter):
    keys = authors(converter).keys
    expected = {
        "policy.d_state": WIDTH,
        "policy.d_action": WIDTH,
        "policy.d_robot": ACTION_DIM,
        "policy.horizon": HORIZON,
        "policy.max_views": 3,
        "policy.n_token": N_TOKEN,
        "policy.pad_token": FIRST_ADDED,
        "policy.masked_rows": "zero_attention",
        "policy.absent_views": "in_place",
        "policy.time_scale": 999.0,
        "solver.kind": "euler",
        "solver.steps": 50,
        "solver.t_start": 0.0,
        "solver.t_end": 1.0,
        "solver.noise": "uniform",
        "lm.n_layer": N_LAYER,
        "lm.d_head": 4,
        "lm.rope_base": 1e6,
        "connector.factor": 2,
        "head.d_ff": 4 * D_MODEL,
        "observation.views": ["observation.images.front", "observation.images.wrist"],
        "observation.view_optional": [0, 0],
        "observation.min_views": 1,
        "observation.state_dims": [STATE_DIM],
        "observation.max_text_tokens": N_TOKEN,
    }
    assert {name: keys[name] for name in expected} == expected


def test_recipe_of_the_authors_second_revision(converter):
    found = recipe(authors(converter))
    assert found["image"] == [
        {"op": "resize", "width": 56, "height": 56, "filter": "opencv_bilinear"},
        {"op": "standardize", "mean": [0.485, 0.456, 0.406], "std": [0.229, 0.224, 0.225], "arithmetic": "bfloat16"},
    ]
    views = {"op": "views", "count": 3, "open": "Image-{i}: <img>", "token": "<IMG_CONTEXT>", "repeat": 4, "close": "</img>\n"}
    assert found["text"] == [{"op": "strip"}, views, {"op": "tokenize", "max_tokens": N_TOKEN, "truncate": "right"}]
    assert found["state"] == [
        {"op": "normalize", "kind": "evo1_min_max", "stats": STATE, "eps": 1e-8},
        {"op": "clip", "low": -1.0, "high": 1.0},
        {"op": "pad", "size": WIDTH},
    ]
    assert found["action"] == [
        {"op": "take", "size": ACTION_DIM},
        {"op": "unnormalize", "kind": "evo1_min_max", "stats": ACTION, "eps": 1e-8},
    ]


def test_the_first_revision_differs_in_steps_times_pixels_and_padding(converter):
    bundle = authors(converter, variant="r1")
    found = recipe(bundle)
    assert (bundle.keys["solver.steps"], bundle.keys["policy.time_scale"]) == (32, 1000.0)
    assert found["image"][1]["arithmetic"] == "float32_then_bfloat16"
    assert found["state"][-1] == {"op": "pad", "size": WIDTH, "value": -1.0}


def test_a_config_of_the_first_revision_is_noted_where_the_second_is_asked_for(converter):
    tiny = TinyEvo1()
    tiny.config["action_dim"] = HORIZON * WIDTH
    authors(converter, tiny, variant="r1")
    assert not any("--variant" in note for note in converter.summary.notes)
    authors(converter, tiny, variant="r2")
    assert any("is it --variant r1?" in note for note in converter.summary.notes)


@pytest.mark.parametrize(
    "name, kind, statistics, clipped",
    [
        ("bounds", "evo1_min_max", ("min", "max"), True),
        ("bounds_q99", "evo1_quantiles", ("q01", "q99"), True),
        ("normal", "evo1_mean_std", ("mean", "std"), False),
    ],
)
def test_each_normalization_reads_its_statistics(converter, name, kind, statistics, clipped):
    tiny = TinyEvo1()
    tiny.config["normalization_type"] = name
    bundle = authors(converter, tiny)
    assert recipe(bundle)["state"][0]["kind"] == recipe(bundle)["action"][1]["kind"] == kind
    assert any(op["op"] == "clip" for op in recipe(bundle)["state"]) == clipped
    for statistic in statistics:
        np.testing.assert_array_equal(
            bundle.tensors["{}.{}".format(STATE, statistic)], np.float32(tiny.stats["observation.state"][statistic])
        )
    assert sum(name.startswith("stats.") for name in bundle.tensors) == 4


def test_quantiles_that_are_absent_fall_back_to_the_range_and_a_note_says_so(converter):
    tiny = TinyEvo1()
    tiny.config["normalization_type"] = "bounds_q99"
    del tiny.stats["action"]["q99"]
    bundle = authors(converter, tiny)
    assert recipe(bundle)["state"][0]["kind"] == "evo1_quantiles"
    assert recipe(bundle)["action"][1]["kind"] == "evo1_min_max" and ACTION + ".max" in bundle.tensors
    assert any("no q01 and q99 for action" in note for note in converter.summary.notes)


def test_one_of_several_entries_of_the_statistics_is_chosen_by_name(converter):
    tiny = TinyEvo1()
    tiny.norm_stats[ARM]["other/set"] = TinyEvo1.entry(np.random.default_rng(9))
    bundle = authors(converter, tiny, stats=ARM + "/other/set")
    np.testing.assert_array_equal(bundle.tensors[ACTION + ".min"], np.float32(tiny.norm_stats[ARM]["other/set"]["action"]["min"]))


def test_older_statistics_stand_under_the_arm_alone(converter):
    tiny = TinyEvo1()
    tiny.norm_stats = {"libero_robot": tiny.stats}
    assert STATE + ".min" in authors(converter, tiny, stats="libero_robot").tensors


def test_a_run_without_deepspeed_has_another_file(converter):
    tiny = TinyEvo1()
    tiny.weights, tiny.member = "checkpoint.pt", "model_state_dict"
    assert authors(converter, tiny).keys["vla.arch"] == "evo1"


def test_tables_that_are_stored_in_float32_stay_so_among_bf16_matrices(converter):
    tiny = TinyEvo1()
    name = "action_head.time_pos_enc.pe"
    tiny.tensors[name] = np.random.default_rng(1).standard_normal((1, 1000, D_MODEL)).astype("<f4")
    bundle = authors(converter, tiny)
    assert bundle.keys["vla.dtype"] == "bf16" and bundle.dtypes["time.weight"] == "f32"
    np.testing.assert_array_equal(bundle.tensors["time.weight"], tiny.tensors[name][0])


def test_dropped_layers_of_the_language_model_are_not_asked_for(converter):
    tiny = TinyEvo1()
    assert tiny.backbone["llm_config"]["num_hidden_layers"] > N_LAYER
    assert "lm.blk.{}.attn_q.weight".format(N_LAYER) not in authors(converter, tiny).tensors


def test_places_of_views_are_those_of_the_tokenizers_own_ids(converter):
    """The judge is the library of the format, on the prompt as the references build it."""
    tokenizers = pytest.importorskip("tokenizers")
    tiny = TinyEvo1()
    tiny.dims["prompt_tokens"], tiny.backbone["llm_config"]["max_position_embeddings"] = 400, 400
    keys = authors(converter, tiny, max_views=11).keys
    judge = tokenizers.Tokenizer.from_str(json.dumps(tiny.tokenizer))
    prompt = "".join("Image-{}: <img>{}</img>\n".format(i + 1, "<IMG_CONTEXT>" * N_VIEW_TOKEN) for i in range(11))
    ids = judge.encode(prompt + "pick up", add_special_tokens=False).ids
    image = FIRST_ADDED + 5
    assert keys["policy.view_starts"] == [i for i, t in enumerate(ids) if t == image and ids[i - 1] != image]


def test_the_command_takes_the_answers(converter, capsys):
    folder = converter.save(TinyEvo1())
    flags = "--variant r1 --views observation.images.front,wrist --max-views 2 --masked-rows causal_attention"
    assert main([folder, "-o", converter.out, "--stats", "{}/{}".format(ARM, DATASET), *flags.split()]) == 0
    keys = read_bundle(converter.out).keys
    assert keys["observation.views"] == ["observation.images.front", "observation.images.wrist"]
    assert (keys["policy.max_views"], keys["policy.masked_rows"], keys["solver.steps"]) == (2, "causal_attention", 32)
    assert "the robot's {} action columns".format(ACTION_DIM) in capsys.readouterr().out


def test_every_number_of_lerobots_tensors_is_in_the_bundle(converter):
    tiny = TinyEvo1Lerobot()
    bundle = converter.bundle(tiny)
    stored = sum(array.size for array in tiny.tensors.values())
    assert stored == sum(array.size for name, array in bundle.tensors.items() if not name.startswith("stats."))
    vision = "model.embedder.model.vision_tower."
    one = {
        "vision.class_token.weight": vision + "embeddings.cls_token",
        "vision.blk.0.attn_k.weight": vision + "encoder.layer.0.attention.k_proj.weight",
        "vision.blk.0.attn_scale.weight": vision + "encoder.layer.0.lambda_1",
        "connector.down.weight": "model.embedder.model.multi_modal_projector.linear_2.weight",
        "lm.blk.0.ffn_gate.weight": "model.embedder.model.language_model.layers.0.mlp.gate_proj.weight",
        "velocity_in.bias": "model.action_head.mlp_head.fc1.linear.bias",
    }
    for target, source in one.items():
        np.testing.assert_array_equal(bundle.tensors[target].ravel(), tiny.tensors[source].ravel(), err_msg=target)
    stacked = tiny.tensors["model.action_head.transformer_blocks.0.attn.in_proj_weight"]
    np.testing.assert_array_equal(bundle.tensors["head.blk.0.attn_v.weight"], stacked[2 * D_MODEL :])


def test_keys_and_recipe_of_lerobots_layout(converter):
    bundle = converter.bundle(TinyEvo1Lerobot())
    found = recipe(bundle)
    expected = {
        "policy.d_state": D_STATE,
        "policy.d_action": D_ACTION,
        "policy.d_robot": ACTION_DIM,
        "policy.masked_rows": "unseen",
        "policy.absent_views": "last",
        "policy.time_scale": 999.0,
        "solver.steps": 6,
        "observation.min_views": 2,
    }
    assert {name: bundle.keys[name] for name in expected} == expected
    assert found["image"][0] == {"op": "resize", "width": 56, "height": 56, "filter": "torch_bicubic_8bit"}
    assert found["image"][1]["arithmetic"] == "bfloat16"
    assert found["state"] == [
        {"op": "normalize", "kind": "min_max", "stats": STATE, "eps": 1e-8},
        {"op": "pad", "size": D_STATE},
    ]
    assert found["action"] == [
        {"op": "take", "size": ACTION_DIM},
        {"op": "unnormalize", "kind": "min_max", "stats": ACTION, "eps": 1e-8},
        {"op": "threshold", "columns": [2], "above": 0.25, "then": -1.0, "else": 1.0},
    ]
    assert bundle.tensors[STATE + ".min"].shape == (STATE_DIM,) and bundle.tensors[ACTION + ".max"].shape == (ACTION_DIM,)


def test_the_towers_precision_decides_the_arithmetic_of_pixels(converter):
    tiny = TinyEvo1Lerobot()
    tiny.config["vlm_dtype"] = "float32"
    assert recipe(converter.bundle(tiny))["image"][1]["arithmetic"] == "float32"


@pytest.mark.parametrize("mode", ["MIN_MAX", "MEAN_STD", "QUANTILES", "IDENTITY"])
def test_statistics_without_the_padded_columns_pad_with_zeros(converter, mode):
    tiny = TinyEvo1Lerobot().normalization(mode).cut_statistics()
    found = recipe(converter.bundle(tiny))
    assert found["state"][-1] == {"op": "pad", "size": D_STATE}


@pytest.mark.parametrize(
    "mode, statistics, value",
    [
        ("MIN_MAX", {"min": 0.0, "max": 0.0}, -1.0),
        ("MIN_MAX", {"min": -1.0, "max": 3.0}, -0.5),
        ("QUANTILES", {"q01": 0.5, "q99": 1.5}, -2.0),
        ("MEAN_STD", {"mean": 1.0, "std": 0.5}, -2.0),
    ],
)
def test_stored_statistics_of_padded_columns_count_as_the_reference_reads_them(converter, mode, statistics, value):
    tiny = TinyEvo1Lerobot().normalization(mode)
    for name, number in statistics.items():
        tiny.statistics["observation.state." + name][STATE_DIM:] = number
    assert recipe(converter.bundle(tiny))["state"][-1] == {"op": "pad", "size": D_STATE, "value": pytest.approx(value)}


def test_fewer_columns_than_the_actions_are_taken_when_the_config_asks_for_it(converter):
    tiny = TinyEvo1Lerobot()
    tiny.config.update(postprocess_action_dim=2, binarize_gripper=False)
    tiny.step("evo1_action_processor")["config"].update(action_dim=2, binarize_gripper=False)
    bundle = converter.bundle(tiny)
    assert recipe(bundle)["action"][0] == {"op": "take", "size": 2} and len(recipe(bundle)["action"]) == 2
    assert bundle.keys["policy.d_robot"] == ACTION_DIM and len(bundle.keys["action.names"]) == 2


def test_cameras_that_may_be_missing_are_as_many_as_the_config_says(converter):
    tiny = TinyEvo1Lerobot()
    tiny.config["empty_cameras"] = 1
    keys = converter.bundle(tiny).keys
    assert keys["observation.views"][-1] == "observation.images.empty_camera_0" and keys["observation.min_views"] == 2


def test_a_tokenizer_that_pads_on_the_left_does_for_single_prompts(converter):
    tiny = TinyEvo1Lerobot()
    tiny.tokenizer_config["padding_side"] = "left"
    assert converter.bundle(tiny).keys["policy.pad_token"] == FIRST_ADDED


def test_head_and_towers_of_other_precisions_are_written_as_f32(converter):
    tiny = TinyEvo1Lerobot()
    name = "model.embedder.model.language_model.layers.0.mlp.up_proj.weight"
    tiny.tensors[name] = ("BF16", files.bfloat16_bits(np.ones(tiny.tensors[name].shape)))
    assert converter.bundle(tiny).keys["vla.dtype"] == "f32"
    assert any("mixed types" in note for note in converter.summary.notes)

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What a SmolVLA bundle holds, for checkpoints in every layout that LeRobot writes."""

import json

import numpy as np
import pytest

from tiny import ACTION_DIM, D_VISION, EXPERT, N_LAYER, STATE_DIM, VLM, Tiny, write_json, write_safetensors

from vla_cpp.convert import Code

PAIRS = {  # the bundle's name -> the checkpoint's, one per rule of the mapping
    "vision.position.weight": VLM + "vision_model.embeddings.position_embedding.weight",
    "vision.blk.0.attn_norm.bias": VLM + "vision_model.encoder.layers.0.layer_norm1.bias",
    "vision.blk.0.ffn_norm.weight": VLM + "vision_model.encoder.layers.0.layer_norm2.weight",
    "vision.blk.0.attn_q.weight": VLM + "vision_model.encoder.layers.0.self_attn.q_proj.weight",
    "vision.blk.0.attn_k.weight": VLM + "vision_model.encoder.layers.0.self_attn.k_proj.weight",
    "vision.blk.0.attn_v.bias": VLM + "vision_model.encoder.layers.0.self_attn.v_proj.bias",
    "vision.blk.0.attn_out.weight": VLM + "vision_model.encoder.layers.0.self_attn.out_proj.weight",
    "vision.blk.0.ffn_up.weight": VLM + "vision_model.encoder.layers.0.mlp.fc1.weight",
    "vision.blk.0.ffn_down.bias": VLM + "vision_model.encoder.layers.0.mlp.fc2.bias",
    "vision.post_norm.weight": VLM + "vision_model.post_layernorm.weight",
    "connector.weight": VLM + "connector.modality_projection.proj.weight",
    "lm.token_embd.weight": VLM + "text_model.embed_tokens.weight",
    "lm.blk.0.attn_norm.weight": VLM + "text_model.layers.0.input_layernorm.weight",
    "lm.blk.0.ffn_norm.weight": VLM + "text_model.layers.0.post_attention_layernorm.weight",
    "lm.blk.0.attn_q.weight": VLM + "text_model.layers.0.self_attn.q_proj.weight",
    "lm.blk.0.attn_out.weight": VLM + "text_model.layers.0.self_attn.o_proj.weight",
    "lm.blk.0.ffn_gate.weight": VLM + "text_model.layers.0.mlp.gate_proj.weight",
    "lm.blk.0.ffn_up.weight": VLM + "text_model.layers.0.mlp.up_proj.weight",
    "lm.blk.0.ffn_down.weight": VLM + "text_model.layers.0.mlp.down_proj.weight",
    "lm.blk.1.attn_k.weight": VLM + "text_model.layers.1.self_attn.k_proj.weight",
    "lm.blk.1.attn_v.weight": VLM + "text_model.layers.1.self_attn.v_proj.weight",
    "state_in.weight": "model.state_proj.weight",
    "action_in.bias": "model.action_in_proj.bias",
    "action_time_in.weight": "model.action_time_mlp_in.weight",
    "action_time_out.weight": "model.action_time_mlp_out.weight",
    "expert.blk.0.attn_k.weight": EXPERT + "layers.0.self_attn.k_proj.weight",
    "expert.blk.1.attn_v.weight": EXPERT + "layers.1.self_attn.v_proj.weight",
    "expert.blk.1.ffn_down.weight": EXPERT + "layers.1.mlp.down_proj.weight",
    "expert.norm.weight": EXPERT + "norm.weight",
    "action_out.weight": "model.action_out_proj.weight",
}


def recipe(bundle):
    return json.loads(bundle.keys["processor.recipe"])


def test_every_rule_of_the_mapping_carries_its_tensor_unchanged(converter, tiny):
    bundle = converter.bundle(tiny)
    for target, source in PAIRS.items():
        np.testing.assert_array_equal(bundle.tensors[target], tiny.tensors[source], err_msg=target)


def test_no_two_tensors_of_a_bundle_come_from_one_source(converter, tiny):
    bundle = converter.bundle(tiny)
    contents = [value.tobytes() for name, value in bundle.tensors.items() if not name.startswith("stats.")]
    assert len(set(contents)) == len(contents)


def test_the_patch_convolution_becomes_a_matrix_over_channel_row_column(converter, tiny):
    weight = tiny.tensors[VLM + "vision_model.embeddings.patch_embedding.weight"]
    stored = converter.bundle(tiny).tensors["vision.patch_embed.weight"]
    assert stored.shape == (D_VISION, 48)
    assert stored[5, 2 * 16 + 1 * 4 + 3] == weight[5, 2, 1, 3]


def test_what_no_action_depends_on_is_left_out_and_named(converter, tiny):
    bundle = converter.bundle(tiny)
    last = "lm.blk.{}.".format(N_LAYER - 1)
    assert sorted(name[len(last) :] for name in bundle.tensors if name.startswith(last)) == [
        "attn_k.weight",
        "attn_norm.weight",
        "attn_v.weight",
    ]
    dropped = [name for names in converter.summary.dropped.values() for name in names]
    assert len(dropped) == 8 and "model.vlm_with_expert.vlm.lm_head.weight" in dropped
    assert len(bundle.tensors) == len(tiny.tensors) - len(dropped) + 4  # four statistics


def test_sizes_and_schedule_come_from_the_configs(converter, tiny):
    keys = converter.bundle(tiny).keys
    expected = {
        "vla.arch": "smolvla",
        "vla.bundle_version": 1,
        "vla.dtype": "f32",
        "vla.source.name": "policy",
        "policy.horizon": 6,
        "policy.d_action": 5,
        "vision.image_size": 16,
        "connector.factor": 2,
        "lm.n_layer": 2,
        "lm.n_head_kv": 1,
        "lm.d_head": 4,
        "lm.n_vocab": 300,
        "expert.d_model": 6,
        "expert.d_ff": 256,
        "expert.n_layer": 2,
        "solver.steps": 3,
        "solver.noise": "normal",
        "observation.max_text_tokens": 7,
        "time.min_period": 4e-3,
    }
    assert {key: keys[key] for key in expected} == expected
    assert keys["policy.image_scale"] == np.float32(np.sqrt(12))
    assert keys["lm.rope_base"] == 10000  # not rope_theta of the backbone, which the reference does not read


def test_an_absent_key_means_the_default_of_the_references_class(converter, tiny):
    for key in ("num_steps", "self_attn_every_n_layers"):
        del tiny.config[key]
    keys = converter.bundle(tiny).keys
    assert keys["solver.steps"] == 10 and keys["expert.layer_kinds"] == ["self", "cross"]
    assert keys["vision.norm_eps"] == np.float32(1e-6)  # vision_config states none


def test_the_recipe_is_the_pipelines_arithmetic(converter, tiny):
    assert recipe(converter.bundle(tiny)) == {
        "image": [
            {
                "op": "letterbox",
                "width": 16,
                "height": 16,
                "filter": "bilinear",
                "antialias": False,
                "align": "bottom_right",
                "fill": 0.0,
            },
            {"op": "affine", "scale": 2.0, "shift": -1.0},
        ],
        "text": [{"op": "ensure_suffix", "suffix": "\n"}, {"op": "tokenize", "max_tokens": 7, "truncate": "right"}],
        "state": [
            {"op": "normalize", "kind": "mean_std", "stats": "stats.observation.state", "eps": 1e-8},
            {"op": "pad", "size": 4},
        ],
        "action": [
            {"op": "take", "size": ACTION_DIM},
            {"op": "unnormalize", "kind": "mean_std", "stats": "stats.action", "eps": 1e-8},
        ],
    }


@pytest.mark.parametrize(
    "mode, kind, names",
    [
        ("MEAN_STD", "mean_std", ["mean", "std"]),
        ("MIN_MAX", "min_max", ["max", "min"]),
        ("QUANTILES", "quantiles", ["q01", "q99"]),
        ("QUANTILE10", "quantile10", ["q10", "q90"]),
    ],
)
def test_each_normalization_mode_carries_the_statistics_of_its_formula(converter, tiny, mode, kind, names):
    tiny.normalization(mode)
    bundle = converter.bundle(tiny)
    assert recipe(bundle)["state"][0]["kind"] == kind
    prefix = "stats.observation.state."
    assert sorted(name[len(prefix) :] for name in bundle.tensors if name.startswith(prefix)) == names
    for name in names:
        np.testing.assert_array_equal(bundle.tensors[prefix + name], tiny.stats["observation.state." + name])


def test_identity_mode_leaves_the_state_alone(converter, tiny):
    tiny.normalization("IDENTITY")
    bundle = converter.bundle(tiny)
    assert recipe(bundle)["state"] == [{"op": "pad", "size": 4}]
    assert "stats.observation.state.mean" not in bundle.tensors


def test_state_and_action_statistics_come_from_their_own_pipelines(converter, tiny):
    folder = converter.save(tiny)
    other = Tiny(seed=1)
    write_safetensors(folder + "/post.safetensors", other.stats)
    bundle = converter.bundle()
    np.testing.assert_array_equal(bundle.tensors["stats.observation.state.mean"], tiny.stats["observation.state.mean"])
    np.testing.assert_array_equal(bundle.tensors["stats.action.mean"], other.stats["action.mean"])


def test_a_sharded_checkpoint_gives_the_same_bytes_as_one_file(converter, tiny):
    converter.bundle(tiny)
    whole = open(converter.out, "rb").read()
    (converter.folder / "model.safetensors").unlink()
    converter.bundle(tiny, shards=3)
    assert open(converter.out, "rb").read() == whole


def test_the_older_layout_gives_the_same_weights_statistics_and_recipe(converter, tiny):
    today = converter.bundle(tiny)
    for file in ("policy_preprocessor.json", "policy_postprocessor.json"):
        (converter.folder / file).unlink()
    older = converter.bundle(Tiny().old_layout())
    assert older.keys["processor.recipe"] == today.keys["processor.recipe"]
    assert set(older.tensors) == set(today.tensors)
    for name, value in today.tensors.items():
        np.testing.assert_array_equal(older.tensors[name], value)


def test_names_of_a_compiled_policy_lose_their_infix(converter, tiny):
    plain = converter.bundle(tiny)
    tiny.tensors = {
        name.replace("model.vlm_with_expert", "model._orig_mod.vlm_with_expert"): value
        for name, value in tiny.tensors.items()
    }
    compiled = converter.bundle(tiny)
    np.testing.assert_array_equal(compiled.tensors["connector.weight"], plain.tensors["connector.weight"])


def test_an_embedding_that_is_stored_as_the_tied_head_is_found_by_the_metadata(converter, tiny):
    embedding, head = VLM + "text_model.embed_tokens.weight", "model.vlm_with_expert.vlm.lm_head.weight"
    tiny.tensors[head] = tiny.tensors.pop(embedding)
    tiny.metadata[embedding] = head
    bundle = converter.bundle(tiny)
    np.testing.assert_array_equal(bundle.tensors["lm.token_embd.weight"], tiny.tensors[head])


def test_more_vlm_layers_than_the_backbone_has_means_all_of_them(converter, tiny):
    tiny.backbone["text_config"]["num_hidden_layers"] = N_LAYER
    tiny.config["num_vlm_layers"] = 16
    assert converter.bundle(tiny).keys["lm.n_layer"] == N_LAYER


def test_views_keep_the_order_of_the_config_and_rename_entries_become_aliases(converter, tiny):
    tiny.step("rename_observations_processor")["config"]["rename_map"] = {
        "observation.images.front": "observation.images.wrist"
    }
    keys = converter.bundle(tiny).keys
    assert keys["observation.views"] == ["observation.images.top", "observation.images.wrist"]
    assert keys["observation.view_aliases"] == ["", "observation.images.front"]
    assert keys["observation.min_views"] == 1


@pytest.mark.parametrize("listed", [False, True])
def test_empty_cameras_become_views_that_may_be_absent(converter, tiny, listed):
    tiny.config["empty_cameras"] = 1
    if listed:
        tiny.config["input_features"]["observation.images.empty_camera_0"] = {"type": "VISUAL", "shape": [3, 480, 640]}
    keys = converter.bundle(tiny).keys
    assert keys["observation.views"] == [
        "observation.images.top",
        "observation.images.wrist",
        "observation.images.empty_camera_0",
    ]
    assert list(keys["observation.view_optional"]) == [0, 0, 1]


def test_an_input_feature_that_the_policy_never_reads_is_noted(converter, tiny):
    tiny.config["input_features"]["observation.environment_state"] = {"type": "ENV", "shape": [9]}
    assert converter.bundle(tiny).keys["observation.states"] == ["observation.state"]
    assert any("observation.environment_state" in note for note in converter.summary.notes)


def test_a_data_set_gives_names_and_the_rate(converter, tiny, tmp_path):
    info = {
        "fps": 30,
        "features": {
            "action": {"names": {"motors": ["pan", "grip"]}},
            "observation.state": {"names": {"y": 1, "x": 0, "z": 2}},
        },
    }
    (tmp_path / "info.json").write_text(json.dumps(info))
    keys = converter.bundle(tiny, dataset_info=str(tmp_path / "info.json")).keys
    assert keys["action.names"] == ["pan", "grip"] and keys["action.rate_hz"] == 30
    assert keys["observation.state_names"] == ["x", "y", "z"]


def test_without_a_data_set_names_are_generated_and_the_rate_is_unstated(converter, tiny):
    keys = converter.bundle(tiny).keys
    assert keys["action.names"] == ["action.0", "action.1"] and keys["action.rate_hz"] == 0
    assert keys["observation.state_names"] == ["state.{}".format(i) for i in range(STATE_DIM)]
    assert keys["observation.state_units"] == [""] * STATE_DIM


def test_missing_statistics_pass_only_when_a_person_says_so_and_loudly(converter, tiny):
    for statistic in ("mean", "std"):
        del tiny.stats["observation.state." + statistic]
    bundle = converter.bundle(tiny, identity_stats=["observation.state"])
    assert recipe(bundle)["state"] == [{"op": "pad", "size": 4}]
    assert recipe(bundle)["action"][1]["op"] == "unnormalize"
    assert any(note.startswith("DEGRADED: observation.state") for note in converter.summary.notes)
    assert bundle.keys["vla.degraded"] == ["observation.state"]


def test_a_standard_deviation_of_zero_is_kept_and_noted(converter, tiny):
    tiny.stats["observation.state.std"][1] = 0
    assert converter.bundle(tiny).tensors["stats.observation.state.std"][1] == 0
    assert any("std is 0 at index 1" in note for note in converter.summary.notes)


@pytest.mark.parametrize(
    "policy, vision, option, rule",
    [
        ({}, {}, "", "float32"),
        ({"load_vlm_weights": True}, {}, "", "bfloat16"),
        ({}, {"torch_dtype": "bfloat16"}, "", "bfloat16"),
        ({}, {"dtype": "float32"}, "", "float32"),
        ({"load_vlm_weights": True}, {}, "float32", "float32"),
        ({}, {}, "shifted", "shifted"),
    ],
)
def test_the_position_rule_follows_the_precision_of_the_references_tower(converter, tiny, policy, vision, option, rule):
    tiny.config.update(policy)
    tiny.backbone["vision_config"].update(vision)
    assert converter.bundle(tiny, position_precision=option).keys["vision.position_rule"] == "bucketize_" + rule


def test_the_backbone_may_live_in_another_folder(converter, tiny, tmp_path):
    folder = converter.save(tiny)
    (tmp_path / "elsewhere").mkdir()
    for file in (converter.folder / "vlm").iterdir():
        file.rename(tmp_path / "elsewhere" / file.name)
    assert converter.bundle(backbone=str(tmp_path / "elsewhere")).keys["lm.n_vocab"] == 300
    assert folder not in open(converter.out, "rb").read().decode("latin1")


def test_the_tokenizer_that_the_processor_saved_wins_over_the_backbones(converter, tiny):
    step = tiny.step("tokenizer_processor")
    step["artifacts"] = {"tokenizer_name": "tokenizer"}
    step["config"]["tokenizer_name"] = "tokenizer"
    folder = converter.save(tiny)
    (converter.folder / "tokenizer").mkdir()
    tiny.tokenizer["added_tokens"][1]["content"] = "<own>"
    write_json(folder + "/tokenizer/tokenizer.json", tiny.tokenizer)
    assert "<own>" in converter.bundle(backbone=folder + "/vlm").keys["tokenizer.tokens"]


def test_units_are_taken_by_number_by_feature_or_for_all(converter, tiny):
    for wrong in ("furlong", "elbow=rad", "action=m,action=rad"):
        error = converter.refusal(tiny, units=wrong)
        assert "--units" in error.message() and error.code == Code.USAGE
    assert converter.bundle(tiny, units="rad").keys["observation.state_units"] == ["rad"] * STATE_DIM
    keys = converter.bundle(tiny, units="observation.state=m,action.1=%").keys
    assert keys["observation.state_units"] == ["m"] * STATE_DIM and keys["action.units"] == ["", "%"]


@pytest.mark.parametrize(
    "unit, reach, note",
    [
        ("rad", 90, "are these degrees?"),
        ("deg", 3, "are these radians?"),
        ("", 90, "state the unit with --units"),
        ("deg", 90, ""),
        ("", 3, ""),
    ],
)
def test_units_that_the_statistics_do_not_bear_out_are_noted(converter, tiny, unit, reach, note):
    tiny.old_layout()
    for group in ("normalize_inputs.buffer_observation_state", "normalize_targets.buffer_action", "unnormalize_outputs.buffer_action"):
        tiny.tensors[group + ".mean"] = np.full_like(tiny.tensors[group + ".mean"], reach)
    converter.bundle(tiny, units=unit)
    notes = [line for line in converter.summary.notes if line.startswith("UNITS: ")]
    assert bool(notes) == bool(note) and all(note in line for line in notes)


def test_statistics_of_several_data_sets_are_chosen_by_name(converter, tiny):
    tiny.old_layout()
    for name in [name for name in tiny.tensors if ".buffer_" in name]:
        values = tiny.tensors.pop(name)
        for i, robot in enumerate(("so100-blue", "so100")):
            tiny.tensors[name.replace(".buffer_", ".{}_buffer_".format(robot))] = values + np.float32(i)
    message = converter.refusal(tiny).message()
    assert message.count("--stats: expected whose statistics to normalize with: so100, so100-blue, found nothing") == 1
    assert "--stats" in converter.refusal(tiny, stats="aloha").message()
    blue, plain = (converter.bundle(tiny, stats=name).tensors["stats.action.mean"] for name in ("so100-blue", "so100"))
    assert np.allclose(plain, blue + 1)


def test_statistics_of_one_robot_leave_nothing_to_choose(converter, tiny):
    assert "--stats" in converter.refusal(tiny, stats="so100").message()
    assert "--stats" in converter.refusal(tiny.old_layout(), stats="so100").message()

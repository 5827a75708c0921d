# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Bundles from openpi's PyTorch checkpoints: what a training configuration's name adds, and what is refused."""

import json
import shutil

import numpy as np
import pytest

from tiny_pi import HEAD, LM, TinyOpenpi, TinyPi
from vla_cpp.convert.archs.pi0.layouts import VARIANTS
from vla_cpp.convert.errors import Code

GRIPPERS = [6, 13]


def openpi(variant):
    chosen = VARIANTS[variant]
    return TinyOpenpi(chosen.arch, chosen.asset)


def recipe(bundle):
    return json.loads(bundle.keys["processor.recipe"])


def test_libero_adds_the_state_to_six_relative_actions(converter):
    tiny = openpi("pi0_libero")
    bundle = converter.bundle(tiny, variant="pi0_libero")
    found = recipe(bundle)
    assert bundle.keys["vla.arch"] == "pi0" and bundle.keys["policy.horizon"] == 7
    assert bundle.keys["solver.kind"] == "euler_float32"
    assert found["image"][0] == {
        "op": "letterbox",
        "width": 224,
        "height": 224,
        "filter": "bilinear",
        "antialias": True,
        "align": "center",
        "fill": 0.0,
    }
    assert [op["op"] for op in found["text"]] == ["strip", "replace", "replace", "ensure_suffix", "tokenize"]
    assert [op["op"] for op in found["action"]] == ["take", "unnormalize", "add_state"]
    assert found["action"][2]["columns"] == [0, 1, 2, 3, 4, 5]
    assert found["action"][1] == {"op": "unnormalize", "kind": "openpi_mean_std", "stats": "stats.action", "eps": 1e-6}
    np.testing.assert_array_equal(bundle.tensors["state_in.weight"], tiny.tensors["state_proj.weight"])


def test_statistics_are_cut_to_the_robots_widths(converter):
    tiny = openpi("pi05_droid")
    bundle = converter.bundle(tiny, variant="pi05_droid")
    state = np.asarray(tiny.norm_stats["state"]["q01"], np.float32)
    np.testing.assert_array_equal(bundle.tensors["stats.observation.joint_position.q01"], state[:7])
    np.testing.assert_array_equal(bundle.tensors["stats.observation.gripper_position.q01"], state[7:8])
    assert bundle.tensors["stats.action.q99"].shape == (8,)
    assert bundle.keys["observation.states"] == ["observation.joint_position", "observation.gripper_position"]
    assert bundle.keys["observation.state_dims"] == [7, 1]
    assert [op.get("feature") for op in recipe(bundle)["state"]] == [
        "observation.joint_position",
        "observation.gripper_position",
        None,
    ]


def test_libero_of_pi05_shows_the_network_no_state(converter):
    found = recipe(converter.bundle(openpi("pi05_libero"), variant="pi05_libero"))
    assert found["state"][-1] == {"op": "drop"}
    assert [op["op"] for op in found["text"]] == ["strip", "replace", "replace", "ensure_suffix", "tokenize"]
    assert found["text"][-1]["max_tokens"] == 200
    assert [op["op"] for op in found["action"]] == ["take", "unnormalize"]


def test_aloha_carries_joint_flips_and_grippers_as_data(converter):
    bundle = converter.bundle(openpi("pi0_aloha"), variant="pi0_aloha")
    found = recipe(bundle)
    assert [op["op"] for op in found["state"]] == ["affine", "horn_angle", "affine", "normalize", "pad"]
    assert found["state"][0] == {"op": "affine", "columns": [1, 2, 8, 9], "scale": -1.0, "shift": 0.0}
    assert found["state"][1]["columns"] == GRIPPERS
    assert [op["op"] for op in found["action"]] == ["take", "unnormalize", "add_state", "affine", "affine"]
    assert found["action"][2]["columns"] == [i for i in range(14) if i not in GRIPPERS]
    assert bundle.keys["observation.view_optional"] == [0, 1, 1]


def test_simulated_aloha_has_absolute_actions(converter):
    found = recipe(converter.bundle(openpi("pi0_aloha_sim"), variant="pi0_aloha_sim"))
    assert [op["op"] for op in found["action"]] == ["take", "unnormalize", "affine", "affine"]


@pytest.mark.parametrize("variant", VARIANTS)
def test_every_variant_converts(converter, variant):
    bundle = converter.bundle(openpi(variant), variant=variant)
    chosen = VARIANTS[variant]
    assert bundle.keys["vla.arch"] == chosen.arch
    words = chosen.arch == "pi05" and chosen.discrete_state
    assert any(op["op"] == "template" for op in recipe(bundle)["text"]) == words
    assert len(bundle.keys["action.names"]) == chosen.robot.n_action


def test_a_training_run_without_a_config_has_the_variants_horizon(converter):
    tiny = openpi("pi05_libero")
    tiny.config = None
    assert converter.bundle(tiny, variant="pi05_libero").keys["policy.horizon"] == 10


def test_an_embedding_that_openpi_left_out_as_shared_is_found(converter):
    tiny = openpi("pi0_libero")
    tiny.rename(HEAD[len("model.") :], LM[len("model.") :] + "embed_tokens.weight")
    assert "lm.token_embd.weight" in converter.bundle(tiny, variant="pi0_libero").tensors


def test_without_a_variant_the_known_ones_are_listed(converter):
    error = converter.refusal(openpi("pi0_libero"))
    assert error.code == Code.USAGE and "pi05_droid" in error.message()


def test_a_horizon_alone_is_no_openpi_checkpoint(converter):
    tiny = openpi("pi0_libero")
    del tiny.config["paligemma_variant"]
    converter.save(tiny)
    shutil.rmtree(converter.folder / "assets")
    error = converter.refusal()
    assert error.code == Code.UNSUPPORTED and "config.json: type: expected one of" in error.message()


def test_a_variant_without_a_recipe_is_refused(converter):
    error = converter.refusal(openpi("pi0_libero"), variant="pi0_fast_droid")
    assert error.code == Code.UNSUPPORTED and "pi0_fast_droid" in error.message()


def test_a_variant_does_not_apply_to_a_lerobot_checkpoint(converter):
    error = converter.refusal(TinyPi("pi0"), variant="pi0_libero")
    assert error.code == Code.USAGE and "of type pi0" in error.message()


def test_an_embodiment_that_the_checkpoint_does_not_have_is_refused_with_those_that_it_has(converter):
    error = converter.refusal(openpi("pi0_libero"), variant="pi0_droid")
    assert "assets/droid/norm_stats.json" in error.message() and "physical-intelligence/libero" in error.message()


def without(key, name):
    return lambda tiny: tiny.norm_stats[key].pop(name)


def setting(key, name, value):
    return lambda tiny: tiny.norm_stats[key].update({name: value})


OWN = {
    "model": "pi05", "views": {"front": "image", "wrist": ""}, "states": {"arm": 6, "hand": 2}, "actions": 7, "horizon": 9, "relative": [0, 1],
    "discrete_state": False, "assets": "my/robot",
}


def own(converter, tiny=None, **changed):
    """Saves a checkpoint of an embodiment that no configuration of openpi has. Returns the file that describes it."""
    tiny = tiny or TinyOpenpi("pi05", "my/robot")
    converter.save(tiny)
    (converter.folder / "own.json").write_text(json.dumps({**OWN, **changed}))
    return "own.json"


def test_a_configuration_of_ones_own_is_stated_in_a_file(converter):
    bundle = converter.bundle(variant=own(converter))
    assert bundle.keys["observation.views"] == ["observation.images.front", "observation.images.wrist"]
    assert bundle.keys["observation.view_aliases"] == ["image", ""] and bundle.keys["observation.state_dims"] == [6, 2]
    assert bundle.keys["policy.horizon"] == 7  # config.json's action_horizon counts
    found = recipe(bundle)
    assert found["action"][-1] == {"op": "add_state", "columns": [0, 1]} and found["state"][-1] == {"op": "drop"}
    assert bundle.tensors["stats.action.q01"].shape == (7,)


def test_it_is_as_the_configuration_of_that_name(converter):
    libero = {"model": "pi0", "views": {"image": "observation/image", "wrist_image": "observation/wrist_image"}, "states": {"state": 8}, "actions": 7,
              "horizon": 50, "relative": list(range(6)), "discrete_state": True, "assets": "physical-intelligence/libero"}
    named = converter.bundle(openpi("pi0_libero"), variant="pi0_libero")
    stated = converter.bundle(variant=own(converter, openpi("pi0_libero"), **libero))
    assert stated.keys == named.keys
    assert all(np.array_equal(stated.tensors[name], values) for name, values in named.tensors.items())


def test_it_may_be_for_a_robot_of_openpi(converter):
    tiny = TinyOpenpi("pi05", "trossen")
    converter.save(tiny)
    (converter.folder / "own.json").write_text(json.dumps({"model": "pi05", "robot": "aloha", "horizon": 50, "assets": "trossen"}))
    found = recipe(converter.bundle(variant="own.json"))
    assert [op["op"] for op in found["state"]] == ["affine", "horn_angle", "affine", "normalize", "bins"]
    assert [op["op"] for op in found["action"]] == ["take", "unnormalize", "affine", "affine"]


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"model": "pi0_fast"}, "model: expected pi0 or pi05"),
        ({"views": {}}, "views: expected 1 to 3 views"),
        ({"views": {name: "" for name in "abcd"}}, "views: expected 1 to 3 views"),
        ({"views": ["front"]}, "views: expected 1 to 3 views"),
        ({"states": {"arm": 0}}, "states: expected widths"),
        ({"states": {"arm": True}}, "states: expected widths"),
        ({"actions": None}, "actions: expected a whole number"),
        ({"horizon": 0}, "horizon: expected a whole number"),
        ({"relative": [7]}, "relative: expected columns below 7"),
        ({"relative": [True]}, "relative: expected columns below 7"),
        ({"relative": "all"}, "relative: expected columns of actions"),
        ({"discrete_state": 1}, "discrete_state: expected true or false"),
        ({"assets": ""}, "assets: expected a folder below assets"),
        ({"assets": "../elsewhere"}, "assets: expected a folder below assets"),
        ({"gripper": "binary"}, "gripper: expected one of model, robot"),
        ({"robot": "aloha"}, "robot: expected either a robot of openpi, or views"),
        ({"robot": "umi"}, "robot: expected aloha or droid or libero"),
        ({"robot": ["aloha"]}, "robot: expected aloha or droid or libero"),
    ],
)
def test_what_such_a_file_may_not_say_is_refused(converter, changed, message):
    assert message in converter.refusal(variant=own(converter, **changed)).message()


REFUSED = {
    "norm_stats.state.std: expected 8 numbers, found none": without("state", "std"),
    "norm_stats.actions.mean: expected 7 numbers, found none": without("actions", "mean"),
    "norm_stats.state.mean: expected 8 numbers, found 3 numbers": setting("state", "mean", [1, 2, 3]),
    "norm_stats.state.mean: expected finite numbers, found inf": setting("state", "mean", [1e39] * 8),
    "norm_stats.state.mean: expected 8 numbers, found 'many'": setting("state", "mean", "many"),
    "norm_stats.actions.std: expected numbers >= 0": setting("actions", "std", [-1.0] * 8),
    "config.json: brand_new: expected a key that openpi writes": lambda tiny: tiny.config.update(brand_new=1),
    "config.json: action_dim: expected at least the robot's 8 numbers": lambda tiny: tiny.config.update(action_dim=7),
    "config.json: precision: expected": lambda tiny: tiny.config.update(precision="int8"),
}


@pytest.mark.parametrize("message", REFUSED)
def test_a_checkpoint_of_openpi_is_refused_by_name(converter, message):
    tiny = openpi("pi0_libero")
    REFUSED[message](tiny)
    assert message in converter.refusal(tiny, variant="pi0_libero").message()


def test_other_quantiles_than_the_policys_are_refused_by_name(converter):
    tiny = openpi("pi05_libero")
    tiny.norm_stats["state"] = {"q02": [0.0] * 8, "q98": [1.0] * 8}
    error = converter.refusal(tiny, variant="pi05_libero")
    assert "norm_stats.state.q01: expected 8 numbers, found none (there are q02, q98)" in error.message()


def test_openpi_always_normalizes(converter):
    error = converter.refusal(openpi("pi0_libero"), variant="pi0_libero", identity_stats=["action"])
    assert "found one of openpi" in error.message()


def test_the_weights_of_the_other_family_are_refused(converter):
    tiny = TinyOpenpi("pi05")
    assert "model.state_proj.weight" in converter.refusal(tiny, variant="pi0_libero").message()

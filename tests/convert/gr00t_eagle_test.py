# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Conversion of GR00T N1.5 and N1.6, by the checkpoints of their golden cases."""

import json

import numpy as np
import pytest

from goldens import gr00t_n1_5, gr00t_n1_6
from goldens.parameters import parameter
from saved import Changed
from vla_cpp.convert.archs import gr00t_n1_5 as n1_5
from vla_cpp.convert.archs.gr00t_n1_5 import CONFIGS
from vla_cpp.convert.errors import Code

N1_5, N1_6 = gr00t_n1_5.CASES["gr00t_n1_5/libero"], gr00t_n1_6.CASES["gr00t_n1_6/libero"]
DATA, META = "data_config.json", "experiment_cfg/metadata.json"


def recipe(bundle):
    return json.loads(bundle.keys["processor.recipe"])


def test_patches_and_squares_of_n1_6_are_reordered_as_the_runtime_reads_them(converter):
    bundle = converter.bundle(Changed(N1_6), dtype="f32", **N1_6.options)
    d, side, at = 24, 4, "backbone.model."

    def stored(name, *shape):
        return N1_6.checkpoint.value(at + name, shape, N1_6.seed)

    patch = stored("vision_model.vision_model.embeddings.patch_embedding.weight", d, 3 * side**2)
    ours = bundle.tensors["vision.patch_embed.weight"].reshape(d, 3, side, side)
    np.testing.assert_array_equal(ours, patch.reshape(d, side, side, 3).transpose(0, 3, 1, 2))
    up = stored("mlp1.1.weight", 40, 4 * d)  # a feature of the four patches of a square, then the next feature
    np.testing.assert_array_equal(bundle.tensors["connector.up.weight"].reshape(40, 4, d), up.reshape(40, d, 4).swapaxes(1, 2))
    bias = stored("mlp1.0.bias", 4 * d)
    np.testing.assert_array_equal(bundle.tensors["connector.norm.bias"].reshape(4, d), bias.reshape(d, 4).T)
    np.testing.assert_array_equal(bundle.tensors["connector.up.bias"], stored("mlp1.1.bias", 40))


def test_images_and_prompt_of_n1_6_are_those_of_its_collator(converter):
    bundle = converter.bundle(Changed(N1_6), dtype="f32", **N1_6.options)
    found = recipe(bundle)
    assert found["image"][0] == {"op": "square_pad"}
    assert found["image"][-3] == {"op": "resize", "width": 32, "height": 32, "filter": "pillow_bicubic"}
    assert found["text"][2] == {
        "op": "views", "count": 2, "open": "<image {i}><img>", "token": "<IMG_CONTEXT>", "repeat": 16, "close": "</img>",
        "place": "back",
    }  # fmt: skip
    assert len(bundle.keys["policy.view_starts_from_end"]) == 2 and bundle.keys["policy.view_starts_from_end"][1] == 16 + 3


def test_each_moment_of_the_state_is_a_token_of_n1_6(converter):
    bundle = converter.bundle(Changed(gr00t_n1_6.CASES["gr00t_n1_6/history"]), embodiment="unitree_g1")
    assert bundle.keys["policy.n_state_row"] == 3 and bundle.keys["policy.d_state"] == 3 * 6
    assert bundle.keys["observation.states"][:2] == ["state.hand@-4", "state.arm@-4"]
    assert bundle.tensors["state_in.weight"].shape == (14, 6)


def test_a_robot_of_n1_6_with_more_steps_than_the_head_has_rows_is_refused(converter):
    def change(content):
        for robot in content["processor_kwargs"]["modality_configs"].values():
            robot["action"]["delta_indices"] = list(range(100))

    error = converter.refusal(Changed(N1_6, "processor_config.json", change), **N1_6.options)
    assert "action: delta_indices: expected at most action_horizon" in error.message() and "found 100 steps" in error.message()


def test_n1_5_takes_the_row_and_the_statistics_that_its_data_config_names(converter):
    bundle = converter.bundle(Changed(N1_5), dtype="f32", **N1_5.options)
    shape = (3, 14, 20)
    rows = N1_5.checkpoint.value("action_head.state_encoder.layer1.W", shape, N1_5.seed)
    np.testing.assert_array_equal(bundle.tensors["state_in.weight"], rows[gr00t_n1_5.INDEX].T)
    np.testing.assert_array_equal(
        bundle.tensors["future.weight"], parameter("action_head.future_tokens.weight", (3, 36), N1_5.seed)
    )
    found = recipe(bundle)
    assert found["image"][:3] == [
        {"op": "camera_size", "width": 40, "height": 30},
        {"op": "center_crop", "width": 38, "height": 28},
        {"op": "resize", "width": 28, "height": 28, "filter": "torch_bilinear_cut"},
    ]
    assert [op["op"] for op in found["state"]] == ["normalize", "pad"]  # beyond the range nothing is clipped
    assert [op["op"] for op in found["action"]] == ["rows", "take", "unnormalize"]
    assert found["text"][1]["text"].endswith("{instruction}<|im_end|>\n<|im_start|>assistant\n")


@pytest.mark.parametrize("horizon", [3, 6, 9])
def test_the_network_of_n1_5_has_as_many_rows_as_the_data_config_whatever_its_head_says(converter, horizon):
    bundle = converter.bundle(Changed(N1_5, DATA, lambda c: c.update(horizon=horizon)), **N1_5.options)
    assert bundle.keys["policy.horizon"] == horizon
    assert {"op": "rows", "count": horizon} in recipe(bundle)["action"]


def test_a_data_config_of_n1_5_with_more_rows_than_the_head_has_positions_is_refused(converter):
    changed = Changed(N1_5, DATA, lambda c: c.update(horizon=11))
    error = converter.refusal(changed, **N1_5.options)
    assert "--variant: horizon: expected at most max_seq_len 10, the rows of the head's position table, found 11" in error.message()


def test_keys_of_n1_5_have_modes_of_their_own(converter):
    modes = {"x": "mean_std", "y": "q99", "z": "sin_cos", "roll": "binary", "pitch": None}
    bundle = converter.bundle(Changed(N1_5, DATA, lambda c: c["state"].update(modes)), **N1_5.options)
    normalize = {"op": "normalize", "stats": "stats.observation.state", "eps": 0.0}
    assert recipe(bundle)["state"] == [
        {"op": "threshold", "columns": [3], "above": 0.5, "then": 1.0, "else": 0.0},
        {**normalize, "kind": "groot_n1_5_min_max", "columns": [5, 6, 7]},
        {**normalize, "kind": "groot_n1_5_quantiles", "columns": [1]},
        {**normalize, "kind": "groot_n1_5_mean_std", "columns": [0]},
        {"op": "clip", "low": -1.0, "high": 1.0, "columns": [1]},
        {"op": "sin_cos", "columns": [2]},
        {"op": "pad", "size": 14},
    ]
    assert np.count_nonzero(bundle.tensors["stats.observation.state.mean"]) == 1


def turned(rotation_type, part="state", key="turn", mode=None, target="rotation_6d", width=3, **described):
    """A robot with a rotation in front of its other keys."""

    class Turned(Changed):
        def save(self, folder):
            super().save(folder)
            meta = json.loads((folder / META).read_text())
            robot = meta["my_arm"]
            like = next(iter(robot["statistics"][part].values()))
            robot["statistics"][part] = {key: {name: [2.0 * i + (name in ("max", "q99", "std")) for i in range(width)] for name in like}, **robot["statistics"][part]}
            robot["modalities"].setdefault(part, {})[key] = {"rotation_type": rotation_type, "absolute": True, "continuous": True, **described}
            (folder / META).write_text(json.dumps(meta))
            data = json.loads((folder / DATA).read_text())
            data[part] = {key: mode, **data[part]}
            data["rotations"] = {f"{part}.{key}": target}
            (folder / DATA).write_text(json.dumps(data))

    return Turned(N1_5)


@pytest.mark.parametrize("rotation_type, width", [("quaternion", 4), ("axis_angle", 3), ("euler_angles_yrp", 3)])
@pytest.mark.parametrize("mode, normalize", [(None, "identity"), ("min_max", "groot_n1_5_min_max")])
def test_a_rotation_of_n1_5s_state_becomes_rows_of_its_matrix(converter, rotation_type, width, mode, normalize):
    bundle = converter.bundle(turned(rotation_type, width=width, mode=mode), **N1_5.options)
    n = bundle.tensors["stats.observation.state.min"].size
    assert recipe(bundle)["state"] == [
        {"op": "normalize", "kind": "groot_n1_5_min_max", "stats": "stats.observation.state", "eps": 0.0, "columns": list(range(width, n))},
        {"op": "rotation", "from": rotation_type, "to": "rotation_6d", "normalize": normalize, "column": 0},
        {"op": "pad", "size": 14},
    ]


def test_a_rotation_of_n1_5s_actions_is_given_back_as_the_robot_has_it(converter):
    bundle = converter.bundle(turned("euler_angles_rpy", "action", mode="min_max", target="axis_angle"), **N1_5.options)
    assert recipe(bundle)["action"][-1] == {"op": "rotation", "from": "axis_angle", "to": "euler_angles_rpy", "column": 0}
    for name, bound in (("min", -np.pi), ("max", np.pi)):
        assert bundle.tensors["stats.action." + name][:3].tolist() == [np.float32(bound)] * 3
    raw = converter.bundle(turned("euler_angles_rpy", "action", target="axis_angle", absolute=False), **N1_5.options)
    assert recipe(raw)["action"][-2]["columns"][0] == 3


def test_a_rotation_that_n1_5s_network_has_as_the_robot_is_normalized_as_any_key(converter):
    for target in ("rotation_6d", "axis_angle"):
        bundle = converter.bundle(turned(target, width=3, mode="min_max", target=target), **N1_5.options)
        assert [op["op"] for op in recipe(bundle)["state"]] == ["normalize", "pad"]


PLACE = "experiment_cfg/metadata.json: modalities."


@pytest.mark.parametrize(
    "rotation, message",
    [
        (turned("quaternion", width=3), PLACE + "state.turn: expected 4 numbers of a quaternion, found 3"),
        (turned("euler_angles_rpy", target="axis_angle"), PLACE + "state.turn.rotation_type: expected states: quaternion, axis_angle, "),
        (turned("matrix", width=9), "found matrix as rotation_6d"),
        (turned(None), "found None as rotation_6d"),
        (turned("quaternion", "action", target="axis_angle"), "found quaternion as axis_angle"),
        (turned("euler_angles_rpy", mode="q99"), "found q99, absolute: True"),
        (turned("euler_angles_rpy", mode="min_max", absolute=False), "found min_max, absolute: False"),
    ],
)
def test_a_rotation_that_n1_5s_reference_cannot_convert_is_refused_by_name(converter, rotation, message):
    assert message in converter.refusal(rotation, **N1_5.options).message()


def test_rotations_of_keys_that_n1_5s_robot_lacks_are_refused(converter):
    changed = Changed(N1_5, DATA, lambda c: c.update(rotations={"state.nothing": "rotation_6d"}))
    assert "data_config.json: rotations: expected state.KEY or action.KEY" in converter.refusal(changed, **N1_5.options).message()


def test_rotations_and_sines_of_states_do_not_go_together(converter):
    one = turned("axis_angle")
    one.file, one.change = DATA, lambda c: c["state"].update(x="sin_cos")
    assert "--variant: expected rotations of states, or sines of states, found both" in converter.refusal(one, **N1_5.options).message()


@pytest.mark.parametrize("name", [name for name, config in CONFIGS.items() if config.rotations])
def test_data_configs_of_n1_5_with_rotations_are_those_of_the_authors(converter, monkeypatch, name):
    config, case = CONFIGS[name], gr00t_n1_5.CASES["gr00t_n1_5/modes"]
    given = {"rotation_6d": ("quaternion", 4), "axis_angle": ("euler_angles_rpy", 3), None: (None, 1)}
    robot = {"statistics": {}, "modalities": {"video": {view: {"resolution": [40, 30]} for view in config.video}}}
    for part, keys in (("state", config.state), ("action", config.action)):
        have = {key: given[config.rotations.get(f"{part}.{key}")] for key in keys}
        robot["statistics"][part] = {key: {"min": [-1.0] * width, "max": [1.0] * width} for key, (_, width) in have.items()}
        robot["modalities"][part] = {key: {"rotation_type": kind, "absolute": True, "continuous": True} for key, (kind, _) in have.items()}
    monkeypatch.setattr(n1_5, "EMBODIMENTS", {"new_embodiment": 1})
    monkeypatch.setitem(CONFIGS, name, config._replace(horizon=4))  # this head has no positions for 16 rows
    bundle = converter.bundle(Changed(case, META, lambda c: c.update(new_embodiment=robot)), **{**case.options, "embodiment": "new_embodiment", "variant": name})
    turned = [key for key in config.rotations if key.startswith("state.")]
    ops = [op for op in recipe(bundle)["state"] if op["op"] == "rotation"]
    assert len(ops) == len(turned) and {op["normalize"] for op in ops} == {"groot_n1_5_min_max" if name == "single_panda_gripper" else "identity"}
    states, dims = bundle.keys["observation.states"], bundle.keys["observation.state_dims"]
    assert [sum(dims[: states.index(key)]) for key in turned] == sorted(op["column"] for op in ops)
    assert any(op["op"] == "rotation" for op in recipe(bundle)["action"]) == (name == "oxe_droid")


REFUSED = {
    "config.json: backbone_cfg: project_to_dim: expected None, found 1536": (
        "config.json", lambda c: c["backbone_cfg"].update(project_to_dim=1536)),
    "action_head_cfg: num_target_vision_tokens: expected a whole number": (
        "config.json", lambda c: c["action_head_cfg"].pop("num_target_vision_tokens")),
    "action_head_cfg: new_thing: expected a key": ("config.json", lambda c: c["action_head_cfg"].update(new_thing=1)),
    "action: expected keys with one of min_max, q99, mean_std, binary, null": (DATA, lambda c: c["action"].update(gripper="sin_cos")),
    "modalities.state.x: expected mode binary for numbers that are not continuous, found min_max": (
        META, lambda c: c["my_arm"]["modalities"]["state"].update(x={"continuous": False})),
    "statistics.state.y.max: expected finite numbers, found None": (
        META, lambda c: c["my_arm"]["statistics"]["state"]["y"].pop("max")),
    "statistics.state.y.mean: expected as many numbers as min: ": (
        META, lambda c: c["my_arm"]["statistics"]["state"]["y"].update(mean=[0.0] * 9)),
    "modalities.video: expected one resolution for the cameras image, wrist_image": (
        META, lambda c: c["my_arm"]["modalities"]["video"].update(wrist_image={"resolution": [40, 31]})),
    "--embodiment my_arm: expected one of new_embodiment, oxe_droid": (DATA, lambda c: c.pop("projector_index")),
}  # fmt: skip


@pytest.mark.parametrize("message", REFUSED)
def test_what_of_n1_5_changes_numbers_is_refused_by_name(converter, message):
    file, change = REFUSED[message]
    assert message in converter.refusal(Changed(N1_5, file, change), **N1_5.options).message()


def test_n1_5_asks_for_its_data_config_and_its_robot(converter):
    error = converter.refusal(Changed(N1_5), embodiment="my_arm")
    assert "--variant: expected one of fourier_gr1_arms_only, fourier_gr1_arms_waist" in error.message() and error.code == Code.USAGE
    error = converter.refusal(Changed(N1_5), embodiment="nobody", variant=DATA)
    assert "--embodiment: expected the tag of the robot" in error.message() and "my_arm" in error.message()

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What the bundle of a GR00T N1.7 checkpoint does to images, text, states and actions."""

import json

import numpy as np
import pytest

from tiny_gr00t import CROP, D_STATE, EDGE, HORIZON, TAG, TinyGr00t

STATE, ACTION = "stats.observation.state", "stats.action"
CLIP = {"op": "clip", "low": -1.0, "high": 1.0}


def convert(converter, tiny=None, **options):
    return converter.bundle(tiny or TinyGr00t(), **{"embodiment": TAG, **options})


def recipe(bundle):
    return json.loads(bundle.keys["processor.recipe"])


def test_the_recipe_is_the_authors_pipeline(converter):
    found = recipe(convert(converter))
    side = {"op": "smallest_side", "size": EDGE, "filter": "opencv_area"}
    assert found["image"] == [
        side,
        {"op": "crop_fraction", "fraction": CROP / EDGE},
        side,
        {"op": "size", "width": EDGE, "height": EDGE},
        {"op": "standardize", "mean": [0.5] * 3, "std": [0.5] * 3, "arithmetic": "float32_in_bytes"},
    ]
    view = {"open": "<|vision_start|>", "token": "<|image_pad|>", "repeat": 9, "close": "<|vision_end|>"}
    assert found["text"] == [
        {"op": "lower"},
        {"op": "drop_punctuation"},
        {"op": "views", "count": 2, **view},
        {"op": "template", "text": "<|im_start|>user\n{instruction}<|im_end|>\n"},
        {"op": "tokenize", "max_tokens": 541, "truncate": "right"},
    ]
    normalize = {"op": "normalize", "kind": "groot_min_max", "stats": STATE, "eps": 0.0}
    assert found["state"] == [normalize, CLIP, {"op": "pad", "size": D_STATE}]
    unnormalize = {"op": "unnormalize", "kind": "groot_min_max", "stats": ACTION, "eps": 0.0}
    assert found["action"] == [{"op": "rows", "count": 4}, {"op": "take", "size": 2}, CLIP, unnormalize]


@pytest.mark.parametrize("percentiles, low, high", [(True, "q01", "q99"), (False, "min", "max")])
def test_statistics_stand_one_after_the_other_in_the_order_of_keys(converter, percentiles, low, high):
    tiny = TinyGr00t()
    tiny.kwargs["use_percentiles"] = percentiles
    tiny.robots[TAG]["state"]["modality_keys"].reverse()
    bundle = convert(converter, tiny)
    for feature, kind, keys in ((STATE, "state", ("gripper", "x")), (ACTION, "action", ("x", "gripper"))):
        for ours, theirs in (("min", low), ("max", high)):
            stored = np.concatenate([tiny.statistics[TAG][kind][key][theirs] for key in keys])
            np.testing.assert_array_equal(bundle.tensors["{}.{}".format(feature, ours)], stored)


def test_relative_actions_have_ranges_of_their_own_and_are_added_to_the_state(converter):
    bundle = convert(converter, TinyGr00t().relative())
    assert recipe(bundle)["action"][-1] == {"op": "add_state", "columns": [0]}
    assert bundle.tensors[ACTION + ".min"][0] == -0.25 and bundle.tensors[ACTION + ".max"][0] == 0.5


def test_relative_actions_of_a_checkpoint_without_them_are_as_good_as_absolute(converter):
    tiny = TinyGr00t().relative()
    tiny.kwargs["use_relative_action"] = False
    bundle = convert(converter, tiny)
    assert recipe(bundle)["action"][-1]["op"] == "unnormalize"
    assert bundle.tensors[ACTION + ".min"][0] == tiny.statistics[TAG]["action"]["x"]["q01"][0]


def test_relative_actions_may_have_ranges_for_each_row_of_which_the_robots_are_kept(converter):
    tiny = TinyGr00t().relative()
    tiny.statistics[TAG]["relative_action"]["x"] = {"min": [[-1.0], [-2], [-3], [-4], [-5]], "max": [[1.0], [2], [3], [4], [5]]}
    low = convert(converter, tiny).tensors[ACTION + ".min"]
    assert low.shape == (4, 2) and low[:, 0].tolist() == [-1, -2, -3, -4]
    assert set(low[:, 1]) == {tiny.statistics[TAG]["action"]["gripper"]["q01"][0]}


def test_relative_actions_are_added_to_the_columns_of_the_state_that_they_are_relative_to(converter):
    tiny = TinyGr00t().relative()
    tiny.robots[TAG]["state"]["modality_keys"].reverse()
    assert recipe(convert(converter, tiny))["action"][-1] == {"op": "add_state", "columns": [0], "state_columns": [2]}


@pytest.mark.parametrize("pose, width", [("XYZ_ROT6D", 9), ("XYZ_ROTVEC", 6)])
def test_relative_poses_are_composed_with_the_states(converter, pose, width):
    tiny = TinyGr00t().relative(type="EEF", format=pose)
    tiny.robots[TAG]["state"]["modality_keys"].reverse()
    action = tiny.robots[TAG]["action"]
    action.update(modality_keys=["x"], action_configs=action["action_configs"][:1])
    wide = {"min": [-1.0] * width, "max": [1.0] * width, "q01": [-1.0] * width, "q99": [1.0] * width}
    for kind in ("state", "action", "relative_action"):
        tiny.statistics[TAG][kind]["x"] = wide
    found = recipe(convert(converter, tiny))["action"][-1]
    assert found == {"op": "compose_pose", "format": pose.lower(), "column": 0, "state_column": 2}


def test_keys_are_normalized_each_in_its_own_way(converter):
    tiny = TinyGr00t()
    tiny.kwargs["apply_sincos_state_encoding"] = True
    tiny.robots[TAG]["state"].update(sin_cos_embedding_keys=["x"], mean_std_embedding_keys=["x", "gripper"])
    tiny.robots[TAG]["action"]["mean_std_embedding_keys"] = ["gripper"]
    bundle = convert(converter, tiny)
    state, action = recipe(bundle)["state"], recipe(bundle)["action"]
    assert [(op["op"], op.get("kind"), op.get("columns")) for op in state] == [
        ("normalize", "groot_mean_std", [1, 2]),
        ("sin_cos", None, [0]),
        ("pad", None, None),
    ]
    assert [(op["op"], op.get("kind"), op.get("columns")) for op in action[2:]] == [
        ("clip", None, [0]),
        ("unnormalize", "groot_min_max", [0]),
        ("unnormalize", "groot_mean_std", [1]),
    ]
    assert bundle.tensors[ACTION + ".std"].tolist() == [0.0, tiny.statistics[TAG]["action"]["gripper"]["std"][0]]


def test_states_of_several_moments_are_features_of_their_own_and_one_token(converter):
    tiny = TinyGr00t().relative()
    tiny.config["state_history_length"] = 2
    tiny.robots[TAG]["state"]["delta_indices"] = [-3, 0]
    name = "action_head.state_encoder.layer1.W"
    tiny.tensors[name] = np.concatenate([tiny.tensors[name], -tiny.tensors[name]], axis=1)
    bundle = convert(converter, tiny)
    assert bundle.keys["observation.states"] == ["state.x@-3", "state.gripper@-3", "state.x", "state.gripper"]
    assert bundle.keys["policy.d_state"] == 2 * D_STATE
    assert recipe(bundle)["state"][-1] == {"op": "pad", "size": 2 * D_STATE, "rows": 2}
    assert recipe(bundle)["action"][-1] == {"op": "add_state", "columns": [0], "state_columns": [3]}
    assert bundle.tensors[STATE + ".min"].shape == (6,)


def test_what_hardly_moved_counts_as_still_where_the_reference_finds_it_close(converter):
    tiny = TinyGr00t()
    tiny.statistics[TAG]["state"]["x"].update(q01=[100.0], q99=[100.0005])
    bundle = convert(converter, tiny)
    assert bundle.tensors[STATE + ".max"][0] == bundle.tensors[STATE + ".min"][0] == 100.0


def test_keys_of_means_and_deviations_are_not_clipped(converter):
    tiny = TinyGr00t()
    for kind in ("state", "action"):
        tiny.robots[TAG][kind]["mean_std_embedding_keys"] = ["gripper", "x"]
    bundle = convert(converter, tiny)
    state, action = recipe(bundle)["state"], recipe(bundle)["action"]
    assert [op["op"] for op in state] == ["normalize", "pad"] and state[0]["kind"] == "groot_mean_std"
    assert [op["op"] for op in action] == ["rows", "take", "unnormalize"] and action[-1]["kind"] == "groot_mean_std"
    assert bundle.tensors[STATE + ".std"].shape == (3,) and STATE + ".min" not in bundle.tensors


def test_switches_of_the_processor_leave_their_steps_out(converter):
    tiny = TinyGr00t()
    tiny.kwargs.update(clip_outliers=False, formalize_language=False, crop_fraction=1.0)
    found = recipe(convert(converter, tiny))
    assert [op["op"] for op in found["state"]] == ["normalize", "pad"] and CLIP in found["action"]
    assert [op["op"] for op in found["text"]] == ["views", "template", "tokenize"]
    assert [op["op"] for op in found["image"]] == ["smallest_side", "size", "standardize"]


def test_an_edge_and_a_fraction_count_before_sizes(converter):
    tiny = TinyGr00t()
    tiny.kwargs.update(shortest_image_edge=16, crop_fraction=0.95, image_target_size=None, image_crop_size=None)
    bundle = convert(converter, tiny)
    assert recipe(bundle)["image"][:2] == [
        {"op": "smallest_side", "size": 16, "filter": "opencv_area"},
        {"op": "crop_fraction", "fraction": 0.95},
    ]
    assert bundle.keys["vision.image_width"] == 16 and recipe(bundle)["text"][2]["repeat"] == 16


def test_letterboxed_images_are_square_whatever_the_camera(converter):
    tiny = TinyGr00t()
    tiny.kwargs["letter_box_transform"] = True
    bundle = convert(converter, tiny, camera_size="40x30")
    assert recipe(bundle)["image"][0] == {"op": "square_pad"} and bundle.keys["vision.image_width"] == EDGE


def test_a_cameras_aspect_is_kept(converter):
    bundle = convert(converter, camera_size="34x24")
    # 34x24 -> 17x12 -> crop 15x11 -> 16x12
    assert (bundle.keys["vision.image_width"], bundle.keys["vision.image_height"]) == (16, 12)
    assert recipe(bundle)["image"][3] == {"op": "size", "width": 16, "height": 12}
    assert recipe(bundle)["text"][2]["repeat"] == 4 * 3


# 40x30 -> 16x12 -> crop 14x11 -> 15x12, held to multiples of 4 and to an area
@pytest.mark.parametrize(
    "least, most, width, height",
    [(144, 4096, 16, 12), (12 * 12, 12 * 12, 12, 8), (20 * 20, 4096, 24, 20), (12 * 16, 12 * 16, 16, 12)],
)
def test_the_backbones_image_processor_resizes_what_its_limits_do_not_hold(converter, least, most, width, height):
    tiny = TinyGr00t()
    tiny.images.update(min_pixels=least, max_pixels=most)
    bundle = convert(converter, tiny, camera_size="40x30")
    resize = {"op": "resize", "width": width, "height": height, "filter": "torch_bicubic_16bit"}
    # 40x30 -> 16x12 -> crop 14x11 -> 15x12
    expected = [{"op": "expect_size", "width": 15, "height": 12}, resize, {"op": "size", "width": width, "height": height}]
    assert recipe(bundle)["image"][3:6] == expected
    assert (bundle.keys["vision.image_width"], bundle.keys["vision.image_height"]) == (width, height)


def test_images_within_the_limits_are_not_resized_again(converter):
    tiny = TinyGr00t()
    tiny.images.update(min_pixels=EDGE * EDGE, max_pixels=EDGE * EDGE)
    assert [op["op"] for op in recipe(convert(converter, tiny))["image"]].count("resize") == 0


def test_frames_that_are_padded_have_one_aspect(converter):
    tiny = TinyGr00t()
    tiny.images.update(min_pixels=400, max_pixels=400)
    ops = [op["op"] for op in recipe(convert(converter, tiny, letterbox=True))["image"]]
    assert "resize" in ops and "expect_size" not in ops


def test_letterbox_pads_whatever_the_checkpoint_says(converter):
    assert recipe(convert(converter, letterbox=True))["image"][0] == {"op": "square_pad"}


def test_rows_are_no_more_than_the_networks(converter):
    tiny = TinyGr00t()
    tiny.robots[TAG]["action"]["delta_indices"] = list(range(HORIZON + 3))
    assert recipe(convert(converter, tiny))["action"][0] == {"op": "rows", "count": HORIZON}


def test_a_gripper_becomes_the_sign_that_a_simulator_wants_on_request(converter):
    action = recipe(convert(converter, gripper_sign="gripper"))["action"]
    assert action[-1] == {"op": "threshold", "columns": [1], "above": 0.5, "then": -1.0, "else": 1.0}


def test_a_gripper_that_is_not_there_is_told_with_those_that_are(converter):
    error = converter.refusal(TinyGr00t(), embodiment=TAG, gripper_sign="hand")
    assert "--gripper-sign: expected a key of the actions: x, gripper, found hand" in error.message()


def test_frames_of_several_moments_are_views_of_their_own_the_oldest_first(converter):
    tiny = TinyGr00t()
    tiny.robots[TAG]["video"]["delta_indices"] = [-15, 0]
    bundle = convert(converter, tiny)
    names = ["front@-15", "wrist@-15", "front", "wrist"]
    assert bundle.keys["observation.views"] == ["observation.images." + name for name in names]
    assert bundle.keys["policy.max_views"] == 4 and recipe(bundle)["text"][2]["count"] == 4

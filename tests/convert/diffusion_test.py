# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Diffusion Policy: names against the reference's and the runtime's, moments of an observation, images, refusals."""

import json
from dataclasses import replace

import numpy as np
import pytest

from configs import of_config, sizes_of
from goldens import diffusion
from manifests import check_keys, check_parameters, sources
from vla_cpp.convert.archs.diffusion import mapping
from vla_cpp.convert.archs.diffusion.config import read_sizes

ARCH = "diffusion"
POLICY = diffusion.sizes(8, 4, (8, 16), 8, 8, 2)
SMALL = diffusion.Checkpoint(POLICY, {"top": (33, 40), "wrist": (33, 40)}, d_state=2, d_action=3, d_environment=1)
PUBLISHED = diffusion.published(())
CAMERA = {"type": "VISUAL", "shape": [3, 33, 40]}


def sizes_at(config):
    return sizes_of(read_sizes, of_config(config))


def test_the_published_config_asks_for_the_tensors_of_the_reference():
    sizes = sizes_at(PUBLISHED.config)
    assert sources(mapping, sizes) == PUBLISHED.shapes()
    assert sum(int(np.prod(shape)) for shape in sources(mapping, sizes).values()) == pytest.approx(262.7e6, rel=0.01)


def test_names_shapes_and_storage_are_those_that_the_runtime_declares():
    check_parameters("diffusion", mapping.weights(sizes_at(PUBLISHED.config)))


def test_sizes_at_the_published_config_are_those_of_the_runtimes_manifest():
    check_keys("diffusion", mapping.network_keys(sizes_at(PUBLISHED.config)))


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"use_group_norm": True},
        {"use_separate_rgb_encoder_per_camera": False},
        {"vision_backbone": "resnet34"},
        {"use_film_scale_modulation": False},
        {"down_dims": [16], "kernel_size": 3},
        {"down_dims": [8, 24, 16], "n_obs_steps": 4},
        {"crop_shape": [30, 33]},
        {"resize_shape": [70, 64], "crop_ratio": 0.5},
    ],
)
def test_every_arrangement_asks_for_the_tensors_of_the_reference(change):
    checkpoint = replace(SMALL, policy=POLICY | change)
    assert sources(mapping, sizes_at(checkpoint.config)) == checkpoint.shapes()


def test_a_policy_without_cameras_has_no_views(planned):
    environment = {"observation.environment_state": {"type": "ENV", "shape": [1]}, "observation.state": {"type": "STATE", "shape": [2]}}
    keys, made = planned(path="input_features", value=environment)
    assert (keys["observation.views"], keys["observation.min_views"], keys["policy.n_camera"]) == ([], 0, 0)
    assert json.loads(keys["processor.recipe"])["image"] == []
    assert not any(row.target.startswith("vision") for row in made.weights)


def test_an_observation_has_each_feature_at_each_moment_the_oldest_first(planned):
    keys, _ = planned(path="n_obs_steps", value=3)
    at = "observation."
    assert keys["observation.views"] == [at + "images." + c + k for c in ("top", "wrist") for k in ("@-2", "@-1", "")]
    assert keys["observation.states"] == [at + f + k for f in ("state", "environment_state") for k in ("@-2", "@-1", "")]
    assert keys["observation.state_dims"] == [2, 2, 2, 1, 1, 1] and keys["policy.d_state"] == 9
    assert keys["observation.state_names"][:4] == ["state.0@-2", "state.1@-2", "state.0@-1", "state.1@-1"]
    assert keys["observation.state_names"][-1] == "environment_state.0" and len(keys["observation.state_units"]) == 9
    recipe = json.loads(keys["processor.recipe"])
    assert {op["feature"]: op["stats"] for op in recipe["state"]}["observation.state@-2"] == "stats.observation.state"
    assert recipe["action"][0] == {"op": "rows", "first": 2, "count": 4}
    assert [op["view"] for op in recipe["image"] if op["op"] == "standardize"] == list(range(6))


def test_frames_are_cropped_as_bytes_and_resized_in_floats(planned):
    def image(**policy):
        sizes = sizes_at(replace(SMALL, policy=POLICY | policy).config)
        from vla_cpp.convert.archs.diffusion import image_ops

        return [{key: value for key, value in op.items() if key != "filter"} for op in image_ops(sizes)]

    frame, crop = {"width": 40, "height": 33}, {"width": 33, "height": 30}
    resized = {"op": "resize_floats", "width": 64, "height": 50, "from_width": 40, "from_height": 33}
    assert image() == [{"op": "camera_size", **frame}, {"op": "size", **frame}]
    assert image(crop_shape=[30, 33], crop_ratio=0.5) == [{"op": "camera_size", **frame}, {"op": "center_crop", **crop}, {"op": "size", **crop}]
    assert image(resize_shape=[50, 64]) == [resized]
    assert image(resize_shape=[50, 64], crop_shape=[9, 9]) == [resized]  # the class drops such a crop
    assert image(resize_shape=[50, 64], crop_ratio=0.75) == [resized, {"op": "crop_floats", "width": 48, "height": 37}]


def test_matrices_of_convolutions_have_their_columns_place_by_place(folder, tmp_path):
    from vla_cpp.convert import Options, convert_checkpoint, read_bundle
    from vla_cpp.convert.checkpoint import open_checkpoint
    from vla_cpp.convert.dtypes import to_f32

    convert_checkpoint(str(folder), str(tmp_path / "out.gguf"), Options(dtype="f32"))
    bundle, tensors = read_bundle(str(tmp_path / "out.gguf")).tensors, open_checkpoint(str(folder), {}).tensors

    def stored(name):
        entry = tensors["diffusion.unet." + name]
        return np.concatenate([to_f32(part, entry.dtype) for part in entry.chunks()]).reshape(entry.shape)

    assert np.array_equal(bundle["unet.blk.0.conv1.weight"].reshape(8, 5, 3)[2, 4], stored("down_modules.0.0.conv1.block.0.weight")[2, :, 4])
    up = stored("up_modules.0.2.weight")  # (in, out, place)
    assert np.array_equal(bundle["unet.up.0.even.weight"].reshape(8, 2, 8)[3], np.stack([up[:, 3, 3], up[:, 3, 1]]))
    assert np.array_equal(bundle["unet.up.0.odd.weight"].reshape(8, 2, 8)[3], np.stack([up[:, 3, 2], up[:, 3, 0]]))
    film = stored("mid_modules.1.cond_encoder.1.weight")
    parts = [bundle[f"unet.blk.5.film_{part}.weight"] for part in ("time", "observation")]
    assert np.array_equal(np.concatenate(parts, axis=1), film) and parts[0].shape[1] == 8


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("noise_scheduler_type", "EDM", "noise_scheduler_type: expected DDPM or DDIM"),
        ("prediction_type", "v_prediction", "prediction_type: expected epsilon or sample"),
        ("beta_schedule", "cosine", "beta_schedule: expected linear or scaled_linear or squaredcos_cap_v2 or sigmoid"),
        ("beta_start", -0.1, "beta_start: expected a number from 0 to 1"),
        ("beta_end", True, "beta_end: expected a number from 0 to 1"),
        ("clip_sample", 1, "clip_sample: expected true or false"),
        ("clip_sample_range", 0.0, "clip_sample_range: expected a number above 0"),
        ("num_inference_steps", 101, "num_inference_steps: expected at most num_train_timesteps 100"),
        ("num_train_timesteps", 2000, "num_train_timesteps: expected a whole number from 1 to 1000"),
        ("vision_backbone", "resnet50", "vision_backbone: expected resnet18 or resnet34"),
        ("use_group_norm", "no", "use_group_norm: expected true or false"),
        ("horizon", 10, "horizon: expected a multiple of 4"),
        ("n_action_steps", 8, "n_action_steps: expected at most 7 rows"),
        ("n_obs_steps", 0, "n_obs_steps: expected a whole number from 1"),
        ("n_obs_steps", 40, "n_obs_steps: expected at most 64 frames"),
        ("kernel_size", 4, "kernel_size: expected an odd number"),
        ("diffusion_step_embed_dim", 7, "diffusion_step_embed_dim: expected an even number"),
        ("diffusion_step_embed_dim", 2, "diffusion_step_embed_dim: expected a whole number from 4"),
        ("n_groups", 3, "n_groups: expected a divisor of each of down_dims [8, 16]"),
        ("down_dims", [12, 16], "down_dims: expected a first width that 8 divides"),
        ("down_dims", [], "down_dims: expected 1 to 12 widths"),
        ("crop_shape", [34, 40], "crop_shape: expected at most the frames' [33, 40]"),
        ("crop_shape", [30, 32], "input_features: expected images of more than 32 pixels on one side, since use_group_norm is false, found 32 x 30"),
        ("crop_shape", [5], "crop_shape: expected [height, width]"),
        ("crop_ratio", 1.5, "crop_ratio: expected a number in (0, 1]"),
        ("soft_prompt", 1, "soft_prompt: expected a key of DiffusionConfig"),
        ("input_features/observation.velocity", {"type": "STATE", "shape": [2]}, "input_features.observation.velocity: expected cameras"),
        ("input_features/observation.images.small", {"type": "VISUAL", "shape": [3, 33, 30]}, "input_features: expected cameras of one size"),
        ("input_features", {"observation.images.top": CAMERA}, "input_features.observation.state: expected type STATE"),
        ("input_features", {"observation.state": {"type": "STATE", "shape": [2]}}, "expected a VISUAL feature or several, or observation.environment_state"),
    ],
)
def test_what_the_runtime_does_not_do_is_refused_by_name(refusal, path, value, message):
    assert message in refusal(path=path, value=value)


def test_a_schedule_that_ddim_does_not_have_is_refused():
    checkpoint = replace(SMALL, policy=POLICY | {"noise_scheduler_type": "DDIM", "beta_schedule": "sigmoid"})
    with pytest.raises(Exception, match="beta_schedule: expected linear or scaled_linear or squaredcos_cap_v2"):
        sizes_at(checkpoint.config)


def test_groups_in_the_place_of_pretrained_batch_norms_are_refused():
    checkpoint = replace(SMALL, policy=POLICY | {"use_group_norm": True, "pretrained_backbone_weights": "ResNet18_Weights.IMAGENET1K_V1"})
    with pytest.raises(Exception, match="pretrained_backbone_weights: expected null"):
        sizes_at(checkpoint.config)

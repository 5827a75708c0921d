# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""ACT: names against the reference's and the runtime's, batch norms in convolutions, statistics of pixels, refusals."""

import json

import numpy as np
import pytest

from configs import of_config, sizes_of
from goldens import act
from manifests import check_keys, check_parameters, sources
from vla_cpp.convert import batch_norm
from vla_cpp.convert.archs.act import mapping
from vla_cpp.convert.archs.act.config import read_sizes
from vla_cpp.convert.checkpoint import open_checkpoint
from vla_cpp.convert.errors import ConvertError, Problems
from vla_cpp.convert.images import standardized
from vla_cpp.convert.normalization import Normalization

ARCH = "act"
SMALL = act.Checkpoint(act.policy(3, 8, 2, 12, (1, 1, 1)), {"top": (33, 40), "wrist": (33, 40)}, d_state=2, d_action=2, imagenet=False)
PUBLISHED = act.published({"top": (480, 640), "wrist": (480, 640)})
ONES = {"mean": np.ones(3, np.float32), "std": np.full(3, 0.5, np.float32)}


def sizes_at(config):
    return sizes_of(read_sizes, of_config(config))


def test_the_published_config_asks_for_the_tensors_of_the_reference():
    sizes = sizes_at(PUBLISHED.config)
    assert sources(mapping, sizes) == PUBLISHED.shapes()
    assert sum(int(np.prod(shape)) for shape in sources(mapping, sizes).values()) == pytest.approx(51.6e6, rel=0.01)


def test_names_shapes_and_storage_are_those_that_the_runtime_declares():
    check_parameters("act", mapping.weights(sizes_at(PUBLISHED.config)))


def test_sizes_at_the_published_config_are_those_of_the_runtimes_manifest():
    check_keys("act", mapping.network_keys(sizes_at(PUBLISHED.config)))


@pytest.mark.parametrize("change", [{"pre_norm": True}, {"use_vae": False}, {"vision_backbone": "resnet34"}, {"n_decoder_layers": 7}])
def test_every_arrangement_asks_for_the_tensors_of_the_reference(change):
    checkpoint = act.Checkpoint(act.policy(3, 8, 2, 12, (2, 1, 3)) | change, {"top": (33, 40)}, d_environment=5)
    assert sources(mapping, sizes_at(checkpoint.config)) == checkpoint.shapes()


def test_a_convolution_with_its_batch_norm_is_one_convolution(folder):
    tensors = open_checkpoint(str(folder), {}).tensors
    name, norm = "model.backbone.layer2.0.conv1.weight", "model.backbone.layer2.0.bn1"
    weight, scale, bias, mean, variance = (
        batch_norm.whole(tensors[key]) for key in (name, *(f"{norm}.{part}" for part in batch_norm.PARTS))
    )
    x = np.random.default_rng(0).normal(size=(64, 3, 3))  # under the window: features, rows, columns
    y = (np.einsum("oirc,irc->o", weight, x) - mean) / np.sqrt(variance + 1e-5) * scale + bias
    matrix = batch_norm.folded(tensors[name], norm, tensors).reshape(128, -1)
    shift = batch_norm.folded(tensors[norm + ".bias"], norm, tensors)
    assert matrix.dtype == shift.dtype == np.float32
    assert np.allclose(matrix @ x.transpose(1, 2, 0).ravel() + shift, y, rtol=1e-6, atol=1e-6 * np.abs(y).max())
    exact = weight[5, 7, 2, 1] * scale[5] / np.sqrt(variance[5] + 1e-5)
    assert matrix.reshape(128, 3, 3, 64)[5, 2, 1, 7] == np.float32(exact)  # rounded once


def test_cameras_with_other_statistics_have_ops_of_their_own(planned):
    keys, made = planned()
    ops = json.loads(keys["processor.recipe"])["image"]
    assert [op["op"] for op in ops] == ["camera_size", "size", "standardize", "standardize"]
    assert [op["view"] for op in ops[2:]] == [0, 1] and ops[2]["mean"] != ops[3]["mean"]
    assert not any(name.startswith("stats.observation.images") for name in made.statistics)


def test_frames_of_each_camera_keep_their_size(planned):
    keys, _ = planned(path="input_features/observation.images.top/shape", value=[3, 20, 48])
    ops = json.loads(keys["processor.recipe"])["image"]
    assert ops[:4] == [
        {"op": "camera_size", "view": 0, "width": 48, "height": 20},
        {"op": "camera_size", "view": 1, "width": 40, "height": 33},
        {"op": "canvas", "width": 48, "height": 33},
        {"op": "size", "width": 48, "height": 33},
    ]
    assert (keys["vision.image_width"], keys["vision.image_height"], keys["vision.view_sizes"]) == (48, 33, [48, 20, 40, 33])


def test_an_absent_mapping_is_that_of_the_class():
    checkpoint = of_config({key: value for key, value in SMALL.config.items() if key != "normalization_mapping"})
    sizes_of(read_sizes, checkpoint)
    assert checkpoint.config["normalization_mapping"]["VISUAL"] == "MEAN_STD"  # as the older layout's migration reads it


def test_more_cameras_than_the_runtime_has_are_refused(refusal):
    camera = {"type": "VISUAL", "shape": [3, 33, 40]}
    features = SMALL.config["input_features"] | {f"observation.images.extra{i}": camera for i in range(63)}
    assert "input_features: expected at most 64 cameras, found 65" in refusal(path="input_features", value=features)


def test_cameras_with_the_same_statistics_share_an_op():
    problems, norm = Problems("test"), Normalization("mean_std", 1e-8, ONES)
    assert standardized([("a", norm), ("b", norm)], problems) == [
        {"op": "standardize", "mean": [1.0] * 3, "std": [0.5] * 3, "arithmetic": "float32"}
    ]
    ranges = Normalization("min_max", 1e-8, {"min": np.zeros(3, np.float32), "max": np.full(3, 0.5, np.float32)})
    assert standardized([("a", ranges)], problems)[1:] == [{"op": "affine", "scale": 2.0, "shift": -1.0}]
    assert standardized([("a", Normalization())], problems) == []
    flat = Normalization("min_max", 1e-8, {"min": np.zeros(3, np.float32), "max": np.zeros(3, np.float32)})
    standardized([("a", flat)], problems)
    with pytest.raises(ConvertError, match="statistics of a: expected pixels that differ"):
        problems.raise_any()


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("vision_backbone", "resnet50", "vision_backbone: expected resnet18 or resnet34"),
        ("replace_final_stride_with_dilation", True, "replace_final_stride_with_dilation: expected False"),
        ("feedforward_activation", "glu", "feedforward_activation: expected relu or gelu"),
        ("pre_norm", 1, "pre_norm: expected true or false"),
        ("n_heads", 3, "n_heads: expected a divisor of dim_model 8"),
        ("dim_model", 6, "dim_model: expected a multiple of 4"),
        ("temporal_ensemble_coeff", -0.1, "temporal_ensemble_coeff: expected 0 or more"),
        ("n_obs_steps", 2, "n_obs_steps: expected 1"),
        ("chunk_size", 2, "n_action_steps: expected at most chunk_size 2"),
        ("soft_prompt", 1, "soft_prompt: expected a key of ACTConfig"),
        ("input_features/observation.velocity", {"type": "STATE", "shape": [2]}, "input_features.observation.velocity: expected cameras"),
        ("input_features", {"observation.images.top": {"type": "VISUAL", "shape": [3, 33, 40]}}, "input_features.observation.state: expected type STATE"),
        ("input_features", {"observation.state": {"type": "STATE", "shape": [2]}}, "expected a VISUAL feature or several"),
    ],
)
def test_what_the_runtime_does_not_do_is_refused_by_name(refusal, path, value, message):
    assert message in refusal(path=path, value=value)


def test_missing_statistics_of_a_camera_are_refused(refusal):
    message = refusal("policy_preprocessor.json", "steps/3/state_file", None)
    assert "statistics of observation.images.wrist: mean: expected 3 numbers for MEAN_STD" in message


def test_a_feature_that_the_processor_leaves_out_is_refused(refusal):
    message = refusal("policy_preprocessor.json", "steps/3/config/normalize_observation_keys", ["observation.state"])
    assert "normalize_observation_keys: expected observation.images.top among them" in message


def test_ensembling_is_the_clients_and_told():
    checkpoint = of_config(SMALL.config | {"temporal_ensemble_coeff": 0.01, "n_action_steps": 1})
    sizes_of(read_sizes, checkpoint)
    assert any('blend="ensemble", decay=0.01' in note for note in checkpoint.notes)

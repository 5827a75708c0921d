# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""GR00T N1.7 as LeRobot saves it: the bundle is that of the authors' files, and what LeRobot does otherwise is refused."""

import json

import numpy as np
import pytest

from goldens.files import write_safetensors
from tiny import save_shards, write_json
from tiny_gr00t import HORIZON, TAG, TinyGr00t
from vla_cpp.convert import Code, Options, convert_checkpoint, read_bundle


class Saved:
    """A TinyGr00t as LeRobot's save_pretrained writes it, as plain values to change before `convert`."""

    def __init__(self, folder, tiny):
        self.base, self.own, self.out = folder / "base", folder / "own", str(folder / "own.gguf")
        tiny.save(self.base)
        kwargs, robot = tiny.kwargs, tiny.robots[TAG]
        self.tensors = {"_groot_model." + name: values for name, values in tiny.tensors.items()}
        self.config = {
            "type": "groot", "n_obs_steps": 1, "input_features": {}, "output_features": {}, "chunk_size": HORIZON, "n_action_steps": HORIZON,
            "base_model_path": "nvidia/GR00T-N1.7-3B", "embodiment_tag": TAG, "num_inference_timesteps": None, "rtc_ramp_rate": None,
            "action_decode_transform": None, "lora_rank": 0, "use_peft": False,
        }
        self.pack = {
            "state_horizon": 1, "action_horizon": HORIZON, "valid_action_horizon": 4, "video_horizon": 1, "language_key": "task",
            "formalize_language": kwargs["formalize_language"], "embodiment_tag": TAG, "embodiment_mapping": tiny.embodiments,
            "normalize_min_max": True, "state_dropout_prob": 0.2, "clip_outliers": kwargs["clip_outliers"],
            "use_percentiles": kwargs["use_percentiles"], "video_modality_keys": robot["video"]["modality_keys"],
            "raw_stats": tiny.statistics[TAG], "modality_config": robot, "max_state_dim": kwargs["max_state_dim"],
            "max_action_dim": kwargs["max_action_dim"],
        }  # fmt: skip
        sizes = ("image_crop_size", "image_target_size", "shortest_image_edge", "crop_fraction", "use_albumentations", "letter_box_transform")
        self.encode = {"model_name": "nvidia/Cosmos-Reason2-2B", **{name: kwargs[name] for name in sizes}}
        self.decode = {
            "env_action_dim": 3, "raw_stats": tiny.statistics[TAG], "modality_config": robot, "use_percentiles": kwargs["use_percentiles"],
            "use_relative_action": kwargs["use_relative_action"], "action_decode_transform": None,
        }  # fmt: skip
        names = ("q01", "q99") if kwargs["use_percentiles"] else ("min", "max")
        of_keys = [tiny.statistics[TAG]["state"][key] for key in robot["state"]["modality_keys"]]
        self.states = {f"observation.state.{part}": np.concatenate([one[name] for one in of_keys]).astype("<f4") for part, name in zip(("min", "max"), names)}
        self.before = {"rename_observations_processor": {"rename_map": {}}, "to_batch_processor": {}, "groot_n1_7_pack_inputs_v1": self.pack}
        self.before |= {"groot_n1_7_vlm_encode_v1": self.encode, "device_processor": {"device": "cpu"}}
        self.after = {"groot_n1_7_action_decode_v1": self.decode, "device_processor": {"device": "cpu"}}

    def convert(self, **options):
        self.own.mkdir(exist_ok=True)
        write_json(self.own / "config.json", self.config)
        for name, steps in (("pre", self.before), ("post", self.after)):
            steps = [{"registry_name": step, "config": settings} for step, settings in steps.items()]
            if name == "pre" and len(steps) > 2 and self.states:
                steps[2]["state_file"] = "state.safetensors"
                write_safetensors(self.own / "state.safetensors", self.states)
            write_json(self.own / f"policy_{name}processor.json", {"name": "x", "steps": steps})
        save_shards(str(self.own), self.tensors, 1)
        options = {"base": str(self.base), **options}
        self.summary = convert_checkpoint(str(self.own), self.out, Options(dtype="f32", **options), force=True)
        return read_bundle(self.out)

    def refusal(self, **options):
        with pytest.raises(Exception) as info:
            self.convert(**options)
        return info.value


@pytest.fixture
def saved(tmp_path):
    return Saved(tmp_path, TinyGr00t().relative())


def test_the_bundle_is_that_of_the_authors_files(saved, tmp_path):
    found = saved.convert()
    convert_checkpoint(str(saved.base), str(tmp_path / "base.gguf"), Options(embodiment=TAG, dtype="f32"))
    expected = read_bundle(str(tmp_path / "base.gguf"))
    told = {"vla.source.name", "vla.checksum", "processor.recipe"}
    made, published = (json.loads(bundle.keys["processor.recipe"]) for bundle in (found, expected))
    assert made["text"].pop(0) == {"op": "if_empty", "text": "Perform the task."} and made == published
    assert {k: v for k, v in found.keys.items() if k not in told} == {k: v for k, v in expected.keys.items() if k not in told}
    assert found.tensors.keys() == expected.tensors.keys()
    assert all(np.array_equal(found.tensors[name], expected.tensors[name]) for name in expected.tensors)
    assert found.keys["vla.arch"] == "gr00t_n1_7" and found.keys["vla.source.name"] == "own on base"


def test_a_chunk_has_no_more_rows_than_lerobot_answers(saved):
    saved.config["n_action_steps"] = 2
    assert json.loads(saved.convert().keys["processor.recipe"])["action"][0] == {"op": "rows", "count": 2}


def test_steps_of_the_solver_are_the_configs_where_it_states_them(saved):
    saved.config["num_inference_timesteps"] = 7
    assert saved.convert().keys["solver.steps"] == 7


def test_the_base_is_asked_for_with_the_name_of_the_policy_that_has_the_sizes(saved):
    error = saved.refusal(base="")
    assert "--base DIR" in error.message() and "nvidia/GR00T-N1.7-3B" in error.message() and error.code == Code.IO


def test_another_robot_than_the_policys_is_refused(saved):
    error = saved.refusal(embodiment="other")
    assert f"--embodiment: expected {TAG}" in error.message() and error.code == Code.USAGE


def test_a_gripper_is_turned_for_libero_as_the_config_says_whatever_the_step_says(saved):
    saved.config["action_decode_transform"] = "libero"
    gripper = {"columns": [1]}
    ends = [{"op": "affine", **gripper, "scale": -2.0, "shift": 1.0}, {"op": "sign", **gripper}]
    assert json.loads(saved.convert().keys["processor.recipe"])["action"][-2:] == ends
    saved.config["action_decode_transform"], saved.decode["action_decode_transform"] = None, "libero"
    assert json.loads(saved.convert().keys["processor.recipe"])["action"][-1] != ends[-1]
    assert "action_decode_transform of config.json" in refused_gripper(saved)


def refused_gripper(saved):
    saved.config["action_decode_transform"] = "libero"
    return saved.refusal(gripper_sign="gripper").message()


def test_without_albumentations_frames_become_squares_and_a_camera_is_no_option(saved):
    saved.encode["use_albumentations"] = False
    assert json.loads(saved.convert().keys["processor.recipe"])["image"][:2] == [
        {"op": "crop_fraction", "fraction": 1.0}, {"op": "resize", "width": 12, "height": 12, "filter": "torch_bicubic_16bit"}]
    assert "--camera-size" in saved.refusal(camera_size="40x30").message()


def test_a_robot_that_no_mapping_names_is_the_first_one(saved):
    saved.pack["embodiment_mapping"] = {"other": 2}
    first = saved.tensors["_groot_model.action_head.state_encoder.layer1.W"][0].T
    assert np.array_equal(saved.convert().tensors["state_in.weight"], first)


def without_gripper(saved):
    saved.config["action_decode_transform"] = "libero"
    saved.pack["modality_config"]["action"]["modality_keys"] = ["x", "hand"]


def renamed(saved):
    saved.before["rename_observations_processor"]["rename_map"] = {"observation.images.a": "observation.images.front"}


@pytest.mark.parametrize(
    "change, message",
    [
        (renamed, "rename_map: expected {}"),
        (lambda s: s.config.update(lora_rank=8), "lora_rank: expected 0"),
        (lambda s: s.config.update(strange=1), "strange"),
        (without_gripper, "an action key gripper of one number"),
        (lambda s: s.decode.update(env_action_dim=1), "env_action_dim: expected 0, or at least the 2 numbers of the keys"),
        (lambda s: s.decode.pop("raw_stats"), "raw_stats: expected the same as of groot_n1_7_pack_inputs_v1"),
        (lambda s: s.decode.update(modality_config=None), "modality_config: expected the same as of groot_n1_7_pack_inputs_v1"),
        (lambda s: s.states.clear(), "expected a file with them beside the JSON"),
        (lambda s: s.states.update({"observation.state.max": s.states["observation.state.max"] + 1}), "raw_stats: expected the numbers of the step's file"),
        (lambda s: s.pack.update(video_horizon=2), "video_horizon: expected 1, the moments of modality_config"),
        (lambda s: s.decode.update(use_percentiles=False), "use_percentiles: expected the same as of groot_n1_7_pack_inputs_v1"),
        (lambda s: s.pack.update(raw_stats=None), "raw_stats: expected a value"),
        (lambda s: s.pack.update(normalize_min_max=False), "normalize_min_max: expected True"),
        (lambda s: s.pack.update(video_modality_keys=["wrist", "front"]), "video_modality_keys: expected those of modality_config"),
        (lambda s: s.encode.update(sharpen=True), "sharpen"),
        (lambda s: s.tensors.pop(next(iter(s.tensors))), "found none"),
    ],
)
def test_what_lerobot_does_otherwise_is_refused_by_name(saved, change, message):
    change(saved)
    assert message in saved.refusal().message()


def test_the_first_release_of_the_type_is_told(saved):
    saved.before = {"groot_pack_inputs_v3": {}}
    assert "expected rename_observations_processor, to_batch_processor, groot_pack_inputs_v3" in saved.refusal().message()

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""GR00T as LeRobot saves it, where states and actions are one vector each: N1.5, and N1.7 by the statistics of a data set."""

import json

import numpy as np
import pytest
from goldens import groot
from goldens.files import write_safetensors
from saved import Changed
from vla_cpp.convert.errors import Code
from vla_cpp.convert.safetensors_file import read_safetensors

N1_5, N1_7 = groot.CASES["groot/n1_5"], groot.CASES["groot/n1_7"]
PRE, POST, CONFIG, BASE = "policy_preprocessor.json", "policy_postprocessor.json", "config.json", "base/config.json"
RECIPE = "processor.recipe"


class Counted(Changed):
    """The statistics of the first pipeline are others."""

    def __init__(self, case, **numbers):
        super().__init__(case)
        self.numbers = numbers

    def save(self, folder):
        super().save(folder)
        file = next(folder.glob("policy_preprocessor_step_*.safetensors"))
        found = {name: np.concatenate([*entry.chunks()]).reshape(entry.shape) for name, entry in read_safetensors(str(file)).entries.items()}
        write_safetensors(file, {name: x for name, x in (found | self.numbers).items() if x is not None})


def step(name, **values):
    """A change of fields of a step."""

    def change(pipeline):
        next(one["config"] for one in pipeline["steps"] if one["registry_name"] == name).update(values)

    return change


@pytest.fixture
def made(converter):
    def make(tiny, **options):
        return converter.bundle(tiny, **{"dtype": "f32", "base": str(converter.folder / "base"), "backbone": str(converter.folder / "vlm")} | options)

    return make


@pytest.fixture
def refused(converter):
    def refuse(tiny, **options):
        return converter.refusal(tiny, **{"base": str(converter.folder / "base"), "backbone": str(converter.folder / "vlm")} | options)

    return refuse


def recipe(bundle):
    return json.loads(bundle.keys[RECIPE])


def test_n1_5_squeezes_sorted_cameras_and_prints_the_instruction_in_a_list(made):
    bundle = made(Changed(N1_5))
    assert bundle.keys["vla.arch"] == "gr00t_n1_5" and bundle.keys["vla.source.name"] == "policy on base"
    assert list(bundle.keys["observation.views"]) == ["observation.images.front", "observation.images.wrist"]
    assert list(bundle.keys["observation.states"]) == ["observation.state"] and list(bundle.keys["observation.state_dims"]) == [6]
    found = recipe(bundle)
    assert found["image"][0] == {"op": "resize", "width": 28, "height": 28, "filter": "torch_bicubic_16bit"}
    assert [op["op"] for op in found["text"]] == ["refuse", "refuse", "if_empty", "python_list", "views", "template", "tokenize"]
    assert found["text"][2]["text"] == "Perform the task."
    normalize = {"op": "normalize", "kind": "groot_n1_5_min_max", "stats": "stats.observation.state", "eps": 0.0}
    assert found["state"] == [normalize, {"op": "pad", "size": 9}]
    assert [op["op"] for op in found["action"]] == ["rows", "take", "unnormalize"] and found["action"][0]["count"] == 6


def test_the_row_of_the_robot_is_that_of_the_steps_tag_and_the_first_one_for_an_unknown_tag(made):
    shape = (3, 9, 18)
    rows = N1_5.checkpoint.value("action_head.state_encoder.layer1.W", shape, N1_5.seed)
    for tag, row in (("new_embodiment", 2), ("gr1", 1), ("nobody", 0)):
        bundle = made(Changed(N1_5, PRE, step("groot_pack_inputs_v3", embodiment_tag=tag)))
        np.testing.assert_array_equal(bundle.tensors["state_in.weight"], rows[row].T)


def test_n1_7_of_a_data_set_has_the_pipeline_without_albumentations(made):
    bundle = made(Changed(N1_7))
    found = recipe(bundle)
    assert bundle.keys["vla.arch"] == "gr00t_n1_7" and bundle.keys["action.n_action_steps"] == 5
    assert [op["op"] for op in found["image"]] == ["crop_fraction", "resize", "crop_fraction", "resize", "size", "standardize"]
    assert found["image"][0]["fraction"] == 1 and int(32 * found["image"][2]["fraction"]) == 29
    assert [op["op"] for op in found["state"]] == ["normalize", "clip", "pad"]
    assert [op["op"] for op in found["action"]] == ["rows", "take", "clip", "unnormalize", "affine", "sign"]
    assert found["action"][0]["count"] == 5 and found["action"][-1]["columns"] == [6]


def test_a_gripper_is_turned_for_libero_as_the_config_and_its_robot_say(made):
    def last(**config):
        return recipe(made(Changed(N1_7, CONFIG, lambda c: c.update(config))))["action"][-1]["op"]

    assert last(action_decode_transform="auto", embodiment_tag="libero_sim") == last(action_decode_transform="LIBERO") == "sign"
    assert last(action_decode_transform="auto") == last(action_decode_transform="none", embodiment_tag="libero_sim") == "unnormalize"


@pytest.mark.parametrize("case, name", [(N1_5, "groot_pack_inputs_v3"), (N1_7, "groot_n1_7_pack_inputs_v1")])
def test_the_width_of_the_state_is_that_of_its_statistics_with_a_note(made, converter, case, name):
    width = len(case.state) - 1
    numbers = {f"observation.state.{part}": np.arange(width, dtype="<f4") + k for k, part in enumerate(("min", "max"))}
    bundle = made(Counted(case, **numbers))
    assert list(bundle.keys["observation.state_dims"]) == [width]
    assert any(f"observation.state has {width} numbers, as its statistics do" in note for note in converter.summary.notes)


def test_fewer_rows_than_the_chunk_has_are_told_to_be_others_in_lerobots_own_loop(made, converter):
    bundle = made(Changed(N1_5, CONFIG, lambda c: c.update(n_action_steps=4)))
    assert bundle.keys["action.n_action_steps"] == 4 and recipe(bundle)["action"][0]["count"] == 6
    assert any("select_action executes the last 4 of the 6 rows" in note for note in converter.summary.notes)


def feature(name, kind="VISUAL"):
    return lambda c: c["input_features"].update({name: {"type": kind, "shape": [3, 8, 8]}})


REFUSED = {
    "formalize_language: expected False": (N1_5, PRE, step("groot_pack_inputs_v3", formalize_language=True)),
    "groot_pack_inputs_v3: normalize_min_max: expected True": (N1_5, PRE, step("groot_pack_inputs_v3", normalize_min_max=False)),
    "unpack_unnormalize_v1: normalize_min_max: expected True": (N1_5, POST, step("groot_action_unpack_unnormalize_v1", normalize_min_max=False)),
    "language_key: expected 'task'": (N1_5, PRE, step("groot_pack_inputs_v3", language_key="words")),
    "env_action_dim: expected the 5 numbers of the feature action, or 0": (N1_5, POST, step("groot_action_unpack_unnormalize_v1", env_action_dim=4)),
    "max_state_dim: expected 9 as in action_head_cfg of the base": (N1_5, PRE, step("groot_pack_inputs_v3", max_state_dim=10)),
    "tokenizer_assets_repo: expected": (N1_5, PRE, step("groot_eagle_collate_v3", tokenizer_assets_repo="other/one")),
    "base config.json: action_horizon": (N1_5, BASE, lambda c: c.update(action_horizon=5)),
    "n_action_steps: expected at most chunk_size": (N1_5, CONFIG, lambda c: c.update(chunk_size=20)),
    "embodiment_mapping: new_embodiment: expected an index below max_num_embodiments 3": (
        N1_5, PRE, step("groot_pack_inputs_v3", embodiment_mapping={"new_embodiment": 31})),
    "size: expected height and width 28": (N1_5, "vlm/preprocessor_config.json", lambda c: c.update(size={"height": 14, "width": 14})),
    "do_normalize: expected True": (N1_5, "vlm/preprocessor_config.json", lambda c: c.update(do_normalize=False)),
    "tokens_per_tile: expected 4": (N1_5, "vlm/processor_config.json", lambda c: c.update(tokens_per_tile=256)),
    "expected Eagle's, which makes": (
        N1_5, "vlm/chat_template.json", lambda c: c.update(chat_template=groot.TEMPLATE.replace("a helpful assistant", "a robot"))),
    "input_features: expected VISUAL features whose names begin": (N1_5, CONFIG, feature("observation.image")),
    "rename_map: expected {}": (N1_5, PRE, step("rename_observations_processor", rename_map={"a": "b"})),
    "float_dtype: expected None or 'float32'": (N1_7, PRE, step("device_processor", float_dtype="bfloat16")),
    "max_action_dim: expected at least the 5 numbers": (N1_5, CONFIG, lambda c: c.update(max_action_dim=4)),
    "embodiment_tag: expected a name": (N1_5, PRE, lambda c: c["steps"][2]["config"].pop("embodiment_tag")),
    "embodiment_mapping: expected indices of robots": (N1_7, PRE, lambda c: c["steps"][2]["config"].pop("embodiment_mapping")),
    "lora_rank: expected 0": (N1_5, CONFIG, lambda c: c.update(lora_rank=8)),
    "strange: expected a key": (N1_7, POST, step("groot_action_unpack_unnormalize_v2", strange=1)),
    "unpack_unnormalize_v2: normalize_min_max: expected True": (N1_7, POST, step("groot_action_unpack_unnormalize_v2", normalize_min_max=False)),
    "video_horizon: expected None or 1": (N1_7, PRE, step("groot_n1_7_pack_inputs_v1", video_horizon=2)),
    "video_modality_keys: expected None, or some of the cameras": (N1_7, PRE, step("groot_n1_7_pack_inputs_v1", video_modality_keys=["top"])),
    "use_relative_actions: expected False": (N1_7, CONFIG, lambda c: c.update(use_relative_actions=True)),
    "action_decode_transform: expected auto, none or libero": (N1_7, CONFIG, lambda c: c.update(action_decode_transform="bins")),
    "made relative outside of GR00T's own statistics": (
        N1_7, PRE, lambda c: c["steps"].insert(2, {"registry_name": "relative_actions_processor", "config": {}})),
    "at which LeRobot stops beside the steps of N1.7": (
        N1_7, POST, lambda c: c["steps"][0].update(registry_name="groot_action_unpack_unnormalize_v1")),
    "steps: expected rename_observations_processor": (N1_5, PRE, lambda c: c["steps"].pop(1)),
    "overrides: expected no such field": (N1_5, PRE, lambda c: c["steps"][0].update(overrides={})),
    "save the policy after its training": (N1_5, PRE, lambda c: c["steps"][2].pop("state_file")),
}  # fmt: skip


@pytest.mark.parametrize("message", REFUSED)
def test_what_changes_numbers_is_refused_by_name(refused, message):
    case, file, change = REFUSED[message]
    assert message in refused(Changed(case, file, change)).message()


@pytest.mark.parametrize(
    "numbers, message",
    [
        ({"observation.state.min": None}, "observation.state: min: expected one row of finite numbers, found none"),
        ({"observation.state.max": np.zeros(5, "<f4")}, "as many least as largest numbers"),
        ({"observation.state.max": np.full(6, np.inf, "<f4")}, "finite numbers"),
        ({"observation.state.min": np.zeros((2, 3), "<f4")}, "expected one row"),
        ({f"observation.state.{part}": np.zeros(12, "<f4") for part in ("min", "max")}, "max_state_dim: expected at least the 12 numbers of the statistics"),
    ],
)  # fmt: skip
def test_statistics_that_fit_no_state_are_refused(refused, numbers, message):
    assert message in refused(Counted(N1_5, **numbers)).message()


@pytest.mark.parametrize("option", [{"variant": "libero"}, {"camera_size": "40x30"}, {"letterbox": True}, {"gripper_sign": "action"}])
def test_what_lerobots_files_state_is_no_option(refused, option):
    error = refused(Changed(N1_5), **option)
    assert "LeRobot's files state it" in error.message() and error.code == Code.USAGE


def test_another_robot_is_refused_and_the_base_asked_for(refused):
    error = refused(Changed(N1_5), embodiment="gr1")
    assert "--embodiment: expected new_embodiment" in error.message() and error.code == Code.USAGE
    error = refused(Changed(N1_5), base="")
    assert "--base DIR" in error.message() and "nvidia/GR00T-N1.5-3B" in error.message() and error.code == Code.IO

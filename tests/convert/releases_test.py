# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Checkpoints of other releases of LeRobot than the one that golden cases are of, and configs without a type."""

import json

import pytest

from goldens import all_cases, vla_jepa
from goldens.cases import backbone_folder
from goldens.files import write_json
from tiny_pi import TinyPi
from vla_cpp.convert.archs import TELLING
from vla_cpp.convert.errors import Code

FIRST = {arch: next(case for name, case in all_cases().items() if name.startswith(arch + "/")) for arch in TELLING}
FIRST["evo1"] = all_cases()["evo1/lerobot"]


def read(path):
    return json.loads(path.read_text())


def changed(path, change):
    content = read(path)
    change(content)
    write_json(path, content)


@pytest.fixture
def saved(converter):
    """Saves a golden case's checkpoint. Returns its folder and the options of its conversion."""

    def save(case):
        case.checkpoint.write(case.seed, converter.folder)
        return converter.folder, {"backbone": str(backbone_folder(converter.folder) or ""), **case.options}

    return save


@pytest.mark.parametrize("arch", sorted(TELLING))
def test_a_config_without_a_type_is_told_by_its_tensors(converter, saved, arch):
    folder, options = saved(FIRST[arch])
    typed = converter.bundle(**options).keys
    changed(folder / "config.json", lambda config: config.pop("type"))
    assert converter.bundle(**options).keys["vla.checksum"] == typed["vla.checksum"]
    assert any("states no type: read as {}, ".format(arch) in note for note in converter.summary.notes)


def test_tensors_of_no_policy_tell_nothing(converter, tiny):
    del tiny.config["type"]
    tiny.tensors = {name.replace("vlm_with_expert", "other"): value for name, value in tiny.tensors.items()}
    assert "config.json: type: expected one of" in converter.refusal(tiny).message()


# --- VLA-JEPA after 0.6.1 ----------------------------------------------------------------------------------------------------------------

NEWER = {
    "use_relative_actions": False,
    "relative_exclude_joints": ["gripper"],
    "action_feature_names": None,
    "gripper_joint_names": ["gripper"],
    "causal_world_model_context": False,
    "world_model_num_views": None,
}


def relative(enabled, names=None, exclude=("gripper",)):
    return {"registry_name": "relative_actions_processor", "config": {"enabled": enabled, "exclude_joints": [*exclude], "action_names": names}}


@pytest.fixture
def newer(saved):
    """A VLA-JEPA as later releases save it. Returns its folder and options."""

    def save(case="vla_jepa/libero", enabled=False, **config):
        folder, options = saved(all_cases()[case])
        size = read(folder / "config.json").get("resize_images_to")
        changed(folder / "config.json", lambda content: content.update({**NEWER, "use_relative_actions": enabled, **config}))
        prepare = {"registry_name": "vla_jepa_image_prep", "config": {"resize_to": size, "expand_channels": True}}
        changed(folder / "policy_preprocessor.json", lambda content: content["steps"].__setitem__(slice(1, 1), [prepare, relative(enabled)]))

        def add(content):
            names = [step["registry_name"] for step in content["steps"]]
            absolute = {"registry_name": "absolute_actions_processor", "config": {"enabled": enabled}}
            content["steps"].insert(names.index("unnormalizer_processor") + 1, absolute)

        changed(folder / "policy_postprocessor.json", add)
        return folder, options

    return save


@pytest.mark.parametrize("case", sorted(name for name in all_cases() if name.startswith("vla_jepa/")))
def test_steps_that_leave_the_numbers_alone_change_no_byte(converter, saved, newer, case):
    plain = converter.bundle(**saved(all_cases()[case])[1]).keys["vla.checksum"]
    assert converter.bundle(**newer(case)[1]).keys["vla.checksum"] == plain


def test_relative_actions_are_added_to_the_state(converter, newer):
    case = next(name for name, case in all_cases().items() if name.startswith("vla_jepa/") and case.checkpoint.d_state >= case.checkpoint.d_action)
    _, options = newer(case, enabled=True)
    ops = json.loads(converter.bundle(**options).keys["processor.recipe"])["action"]
    kinds = [op["op"] for op in ops]
    assert ops[kinds.index("unnormalize") + 1] == {"op": "add_state", "columns": list(range(all_cases()[case].checkpoint.d_action))}


@pytest.mark.parametrize(
    "change, text",
    [
        (dict(causal_world_model_context=True), "causal_world_model_context: expected False, found True"),
        (dict(world_model_num_views=2), "world_model_num_views: expected None, found 2"),
        (dict(use_relative_actions=True), "use_relative_actions: expected False as the pipelines have it, found True"),
        (dict(resize_images_to=[12, 12]), "vla_jepa_image_prep: resize_to: expected [12, 12] as config.json has it"),
    ],
)
def test_what_would_change_numbers_is_refused(converter, newer, change, text):
    _, options = newer(**change)
    assert text in converter.refusal(**options).message()


# --- π0 of before September 2025 -----------------------------------------------------------------------------------------------------------


def test_a_policy_of_the_first_class_is_named_for_what_it_is(converter):
    policy = TinyPi("pi0")
    policy.config.update(proj_width=1024, num_steps=10, attention_implementation="eager", use_cache=True)
    policy.pre = policy.post = None
    error = converter.refusal(policy)
    assert error.code == Code.UNSUPPORTED and "September 2025" in error.message() and "LeRobot 0.3.3" in error.message()
    assert "attention_implementation, num_steps, proj_width" in error.message() and len(error.problems) == 1

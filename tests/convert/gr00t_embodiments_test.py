# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Several robots of a GR00T checkpoint in one bundle."""

import json

import numpy as np
import pytest

from tiny_gr00t import IDS, OTHER, TAG, TinyGr00t
from vla_cpp.convert.errors import Code

TAGS = [TAG, OTHER]


def view_of(bundle, tag):
    """Keys and tensors as the runtime reads them for one of the robots."""
    own = "embodiment.{}.".format(tag)

    def part(entries):
        shared = {name: value for name, value in entries.items() if not name.startswith("embodiment")}
        mine = {name[len(own) :]: value for name, value in entries.items() if name.startswith(own)}
        assert not set(shared) & set(mine)
        return {**shared, **mine}

    return part(bundle.keys), part(bundle.tensors), part(bundle.dtypes)


def unsealed(keys):
    """Without what differs by nature: the checksum, and the reader's counts of the file."""
    return {name: value for name, value in keys.items() if name != "vla.checksum" and not name.startswith("GGUF.")}


@pytest.mark.parametrize("dtype", ["", "bf16"])
@pytest.mark.parametrize("tags", [TAGS, TAGS[::-1]])
def test_a_robots_part_is_the_bundle_of_that_robot_alone(converter, tags, dtype):
    converter.save(TinyGr00t().relative())
    both = converter.bundle(embodiment=",".join(tags), dtype=dtype, state_bound=7.0)
    assert both.keys["embodiments"] == tags
    for tag in tags:
        alone = converter.bundle(embodiment=tag, dtype=dtype, state_bound=7.0)
        keys, tensors, dtypes = view_of(both, tag)
        assert unsealed(keys) == unsealed(alone.keys) and dtypes == alone.dtypes
        assert set(tensors) == set(alone.tensors)
        for name, array in alone.tensors.items():
            np.testing.assert_array_equal(tensors[name], array, err_msg=name)


def test_what_robots_share_stands_once(converter):
    bundle = converter.bundle(TinyGr00t(), embodiment=",".join(TAGS))
    for name in ("lm.token_embd.weight", "dit.out.weight", "action_position.weight"):
        assert [found for found in bundle.tensors if found.endswith(name)] == [name]
    for name in ("tokenizer.tokens", "policy.horizon", "vla.arch"):
        assert [found for found in bundle.keys if found.endswith(name)] == [name]
    for tag in TAGS:
        assert "embodiment.{}.state_in.weight".format(tag) in bundle.tensors
        assert "embodiment.{}.processor.recipe".format(tag) in bundle.keys
    assert "state_in.weight" not in bundle.tensors and "processor.recipe" not in bundle.keys


def test_robots_are_normalized_each_in_its_own_way(converter):
    tiny = TinyGr00t()
    tiny.robots[TAG]["state"]["mean_std_embedding_keys"] = ["x"]
    bundle = converter.bundle(tiny, embodiment=",".join(TAGS))
    means = [name for name in bundle.tensors if name.endswith("stats.observation.state.mean")]
    assert means == ["embodiment.{}.stats.observation.state.mean".format(TAG)]


def test_robots_of_one_index_share_its_weights_too(converter):
    tiny = TinyGr00t()
    tiny.embodiments[OTHER] = IDS[TAG]
    bundle = converter.bundle(tiny, embodiment=",".join(TAGS))
    assert "state_in.weight" in bundle.tensors
    assert "embodiment.{}.observation.views".format(TAG) in bundle.keys


def test_all_means_every_robot_that_has_statistics(converter):
    tiny = TinyGr00t()
    tiny.robots["untrained"] = tiny.robots[OTHER]
    assert converter.bundle(tiny, embodiment="all").keys["embodiments"] == TAGS
    assert "untrained: left out, statistics.json has no statistics" in converter.summary.notes


def test_one_robot_is_not_named(converter):
    tiny = TinyGr00t()
    del tiny.statistics[OTHER]
    bundle = converter.bundle(tiny, embodiment="all")
    assert not any(name.startswith("embodiment") for name in [*bundle.keys, *bundle.tensors])


def test_a_note_about_the_checkpoint_is_told_once(converter):
    tiny = TinyGr00t()
    tiny.embodiments = {}
    for tag, authors in ((TAG, "simpler_env_google"), (OTHER, "simpler_env_widowx")):
        tiny.robots[authors], tiny.statistics[authors] = tiny.robots[tag], tiny.statistics[tag]
    converter.bundle(tiny, embodiment="simpler_env_google,simpler_env_widowx")
    assert len(converter.summary.notes) == len(set(converter.summary.notes)) >= 2


@pytest.mark.parametrize(
    "embodiment, message",
    [
        ("arm,nobody", "--embodiment: expected the tag of the robot, one of: arm (cameras front, wrist); humanoid"),
        ("arm,", "--embodiment: expected the tag of the robot, one of: arm"),
        ("arm,arm", "--embodiment: expected different tags without dots, found arm,arm"),
        ("arm,a.b", "--embodiment: expected different tags without dots, found arm,a.b"),
    ],
)
def test_tags_that_name_no_robot_or_one_twice_are_refused(converter, embodiment, message):
    error = converter.refusal(TinyGr00t(), embodiment=embodiment)
    assert message in error.message() and error.code == Code.USAGE


def test_a_robot_without_statistics_is_refused_by_name(converter):
    tiny = TinyGr00t()
    del tiny.statistics[OTHER]
    assert "statistics.json: humanoid: expected statistics, found none" in converter.refusal(
        tiny, embodiment=",".join(TAGS)
    ).message()


def test_an_option_may_differ_by_robot(converter, tmp_path):
    tiny = TinyGr00t()
    tiny.kwargs["letter_box_transform"] = False
    info = tmp_path / "info.json"
    info.write_text(json.dumps({"fps": 20, "features": {"observation.state": {}}}))
    own = {
        "gripper_sign": {TAG: "gripper", OTHER: ""},
        "camera_size": {TAG: "640x480", OTHER: "1280x720"},
        "dataset_info": {TAG: "", OTHER: str(info)},
    }
    joint = {name: ",".join(f"{tag}={value}" for tag, value in values.items() if value) for name, values in own.items()}
    both = converter.bundle(tiny, embodiment=",".join(TAGS), **joint)
    for tag in TAGS:
        alone = converter.bundle(tiny, embodiment=tag, **{name: values[tag] for name, values in own.items()})
        assert unsealed(view_of(both, tag)[0]) == unsealed(alone.keys)


@pytest.mark.parametrize(
    "given, message",
    [
        ("arm=gripper,gripper", "--gripper-sign: expected TAG=VALUE once for each of some of the robots arm, humanoid"),
        ("arm=gripper,arm=x", "--gripper-sign: expected TAG=VALUE once for each"),
        ("arm=gripper,dog=x", "--gripper-sign: expected TAG=VALUE once for each"),
        ("arm=", "--gripper-sign: expected TAG=VALUE once for each"),
        ("dog=gripper", "arm: --gripper-sign: expected a key of the actions: x, gripper, found dog=gripper"),
        ("humanoid=claw", "humanoid: --gripper-sign: expected a key of the actions: "),
    ],
)
def test_an_option_that_fits_no_robot_or_not_one_of_them_is_refused_by_name(converter, given, message):
    error = converter.refusal(TinyGr00t(), embodiment=",".join(TAGS), gripper_sign=given)
    assert error.message().startswith(message) and error.code == Code.USAGE

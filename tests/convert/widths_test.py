# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Features that contradict the statistics, and statistics of several data sets inside processor files."""

import json

import numpy as np
import pytest

import tiny_pi
from goldens import act
from goldens.files import write_json
from tiny import Tiny
from vla_cpp.convert.errors import Code


def state_of(checkpoint, width):
    """What the folder says of the state: of the config, and of the normalizer."""
    for features in (checkpoint.config["input_features"], checkpoint.step("normalizer_processor")["config"]["features"]):
        features["observation.state"]["shape"] = [width]
    return checkpoint


def pi(kind):
    return tiny_pi.TinyPi(kind)


@pytest.mark.parametrize("make", [Tiny, lambda: pi("pi0"), lambda: pi("pi05")], ids=["smolvla", "pi0", "pi05"])
@pytest.mark.parametrize("stale", [1, 2, 7])
def test_a_state_that_the_policy_pads_has_the_width_of_its_statistics(converter, make, stale):
    sound = converter.bundle(make())
    got = converter.bundle(state_of(make(), stale))
    assert got.keys["processor.recipe"] == sound.keys["processor.recipe"]
    assert got.keys["observation.state_dims"] == sound.keys["observation.state_dims"]
    assert got.keys["vla.checksum"] == sound.keys["vla.checksum"]
    assert any("as its statistics do, and not the {} of config.json".format(stale) in note for note in converter.summary.notes)


def test_a_normalizer_whose_own_feature_is_sound_is_followed_too(converter, tiny):
    tiny.config["input_features"]["observation.state"]["shape"] = [6]
    tiny.step("normalizer_processor")["config"]["features"]["observation.state"]["shape"] = [3]
    assert converter.bundle(tiny).keys["observation.state_dims"] == [3]


def test_a_state_that_the_config_does_not_list_has_the_width_of_its_statistics(converter, tiny):
    del tiny.config["input_features"]["observation.state"]
    assert "input_features.observation.state" in converter.refusal(tiny, widths="config").message()
    assert converter.bundle(tiny).keys["observation.state_dims"] == [3]
    assert any("and not the none of config.json" in note for note in converter.summary.notes)


def test_the_option_keeps_to_the_config(converter, tiny):
    error = converter.refusal(state_of(tiny, 2), widths="config").message()
    assert "statistics of observation.state: mean: expected shape (2,), found (3,)" in error and "--widths statistics" in error


def test_statistics_wider_than_the_network_are_refused(converter, tiny):
    for name in list(tiny.stats):
        if name.startswith("observation.state."):
            tiny.stats[name] = np.ones(9, np.float32)
    assert "max_state_dim: expected at least the feature's width 9, found 4" in converter.refusal(tiny).message()


def test_statistics_of_two_widths_are_no_answer(converter, tiny):
    tiny.stats["observation.state.std"] = np.ones(2, np.float32)
    assert "statistics of observation.state: std: expected shape (3,), found (2,)" in converter.refusal(tiny).message()


def test_a_single_number_for_all_is_no_width(converter, tiny):
    for name in ("mean", "std"):
        tiny.stats["observation.state." + name] = np.ones(1, np.float32)
    assert "statistics of observation.state: mean: expected shape (3,), found (1,)" in converter.refusal(tiny).message()


def test_what_the_mode_does_not_read_does_not_count(converter, tiny):
    tiny.stats["observation.state.min"] = np.ones(5, np.float32)
    assert converter.bundle(tiny).keys["observation.state_dims"] == [3]


def test_an_action_that_contradicts_its_statistics_is_refused_unless_the_option_says_which_is_right(converter, tiny):
    tiny.config["output_features"]["action"]["shape"] = [1]
    error = converter.refusal(tiny)
    assert error.code == Code.BAD_BUNDLE
    assert "statistics of action: mean: expected shape (1,), found (2,)" in error.message() and "--widths statistics" in error.message()
    assert len(converter.bundle(widths="statistics").keys["action.names"]) == 2


def test_a_network_that_is_as_wide_as_its_state_is_not_guessed(converter):
    case = next(iter(act.CASES.values()))
    case.checkpoint.write(case.seed, converter.folder)
    config = converter.folder / "config.json"
    stated = json.loads(config.read_text())
    width = stated["input_features"]["observation.state"]["shape"][0]
    stated["input_features"]["observation.state"]["shape"] = [width + 1]
    write_json(config, stated)
    assert "expected shape ({},), found ({},)".format(width + 1, width) in converter.refusal().message()
    assert converter.bundle(widths="statistics").keys["observation.state_dims"] == [width]


# --- several data sets -------------------------------------------------------------------------------------------------------------------


def several(tiny, names=("so100", "so100-blue", "so100-red")):
    """As the migration of smolvla_base left them: of actions, one for each data set."""
    tiny.stats = {
        "{}.buffer.action.{}".format(name, statistic): np.full(2, 1 + i, np.float32)
        for i, name in enumerate(names)
        for statistic in ("mean", "std")
    }
    return tiny


def test_of_several_data_sets_one_must_be_named(converter, tiny):
    error = converter.refusal(several(tiny))
    wanted = "--stats: expected whose statistics to normalize with: so100, so100-blue, so100-red, found nothing"
    assert error.message().count(wanted) == 1 and error.problems[0].code == Code.USAGE
    assert wanted.replace("nothing", "aloha") in converter.refusal(tiny, stats="aloha").message()


@pytest.mark.parametrize("i, name", list(enumerate(("so100", "so100-blue", "so100-red"))))
def test_the_named_one_normalizes_and_what_it_has_none_of_is_announced(converter, tiny, i, name):
    bundle = converter.bundle(several(tiny), stats=name)
    assert (bundle.tensors["stats.action.mean"] == 1 + i).all() and "stats.observation.state.mean" not in bundle.tensors
    assert bundle.keys["vla.degraded"] == ["observation.state"]
    assert any(note.startswith("DEGRADED: observation.state") and "--stats " + name in note for note in converter.summary.notes)
    assert [op["op"] for op in json.loads(bundle.keys["processor.recipe"])["state"]] == ["pad"]


def test_a_state_of_the_named_data_set_is_normalized(converter, tiny):
    several(tiny)
    for name in ("mean", "std"):
        tiny.stats["so100-blue.buffer.observation.state." + name] = np.full(3, 5, np.float32)
    bundle = converter.bundle(tiny, stats="so100-blue")
    assert (bundle.tensors["stats.observation.state.std"] == 5).all() and "vla.degraded" not in bundle.keys


def test_statistics_without_a_data_sets_name_count_unless_one_is_named(converter, tiny):
    plain = dict(tiny.stats)
    several(tiny).stats.update(plain)
    assert (converter.bundle(tiny).tensors["stats.action.mean"] == plain["action.mean"]).all()
    named = converter.bundle(tiny, stats="so100-red")
    assert (named.tensors["stats.action.mean"] == 3).all() and "vla.degraded" not in named.keys
    assert (named.tensors["stats.observation.state.mean"] == plain["observation.state.mean"]).all()


def test_of_a_single_data_set_nothing_need_be_said_but_its_missing_state_is_refused(converter, tiny):
    several(tiny, ["so100"])
    assert "statistics of observation.state: mean: expected 3 numbers" in converter.refusal(tiny).message()
    assert (converter.bundle(tiny, identity_stats=["observation.state"]).tensors["stats.action.mean"] == 1).all()

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""A bundle for several robots: each acts as its bundle alone does, and has to be named."""

import json

import numpy as np
import pytest
from convert_and_run_test import convert
from golden_cases import Golden

OTHER = "new_embodiment"  # the second robot of every golden checkpoint of GR00T
KEYS = {"state": {"arm": "min_max"}, "action": {"hand": "binary", "arm": "q99"}}  # of that robot, where a checkpoint does not state them


def converted(name, folder, tags):
    """(case, a bundle of these robots)."""
    case = Golden(name)
    if "variant" in case.said:
        (folder / "other.json").write_text(json.dumps({"video": ["ego_view"], **KEYS, "horizon": 4, "projector_index": 0}))
        case.said["variant"] = f"{case.said['embodiment']}={case.said['variant']},{OTHER}={folder / 'other.json'}"
        if len(tags) == 1:
            case.said["variant"] = str(folder / "other.json")
    case.said["embodiment"] = ",".join(tags)
    return case, convert(case, folder / f"{'-'.join(tags)}.gguf", "bf16")


def joint(name, folder):
    """(case, its robot, a bundle of it and the other robot)."""
    tag = Golden(name).said["embodiment"]
    case, bundle = converted(name, folder, (OTHER, tag))
    return case, tag, bundle


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    return joint("gr00t_n1_7/libero", tmp_path_factory.mktemp("both"))


def answer_of(vla, case, *options, **arguments):
    answer = vla(*case.arguments(options=["--json", *options], **arguments)).json()
    return answer["actions"], answer["action_names"]


@pytest.mark.parametrize("name", ["gr00t_n1_5/libero", "gr00t_n1_6/libero", "gr00t_n1_7/libero", "gr00t_n1_7/two_moments"])
def test_each_robot_of_a_bundle_of_two_answers_the_bits_of_its_bundle_alone(vla, tmp_path, name):
    case, tag, bundle = joint(name, tmp_path)
    assert answer_of(vla, case, "--embodiment", tag, bundle=bundle) == answer_of(vla, case)
    _, alone = converted(name, tmp_path, (OTHER,))
    other = {"images": {"ego_view": next(iter(case.images.values()))}, "state": "arm=0.5,-0.25,2"}
    if "n1_5" in name:  # whose network has as many rows as the robot's data config
        other["noise"] = tmp_path / "noise.npy"
        np.save(other["noise"], np.load(case.noise)[:4])
    assert answer_of(vla, case, "--embodiment", OTHER, bundle=bundle, **other) == answer_of(vla, case, bundle=alone, **other)


def test_each_domain_of_xvla_answers_the_bits_of_its_bundle_alone(vla, tmp_path):
    case, bundle = converted("xvla/two_views", tmp_path, ("0", "1", "2"))
    answers = [answer_of(vla, case, "--embodiment", tag, bundle=bundle) for tag in ("0", "1", "2")]
    assert answers[1] == answer_of(vla, case)  # that of the preprocessor
    _, alone = converted("xvla/two_views", tmp_path, ("2",))
    assert answers[2] == answer_of(vla, case, bundle=alone) != answers[0]


@pytest.mark.parametrize("command", ["run", "bench", "inspect"])
@pytest.mark.parametrize("given, found", [([], "none"), (["--embodiment", "dog"], "dog")])
def test_a_robot_that_is_not_named_or_not_there_is_refused_with_the_list(vla, both, command, given, found):
    case, tag, bundle = both
    arguments = case.arguments(bundle=bundle) if command == "run" else [command, bundle]
    answer = vla(*arguments, *given)
    assert answer.code == 2
    assert f"embodiment: expected one of {OTHER}, {tag}, found {found}" in answer.err


def test_serving_a_robot_that_is_not_there_is_refused_with_the_list(vla, both):
    case, tag, bundle = both
    answer = vla("serve", bundle, "--bind", "tcp://127.0.0.1:0", "--embodiment", "dog")
    assert answer.code == 2 and f"expected one of {OTHER}, {tag}, found dog" in answer.err


def test_a_bundle_of_one_robot_takes_no_tag(vla, both):
    case, tag, _ = both
    answer = vla("inspect", case.bundle, "--embodiment", tag)
    assert answer.code == 2 and "is for one robot, which it does not name, found " + tag in answer.err


def test_inspect_lists_the_robots_and_shows_the_one_that_is_named(vla, both):
    case, tag, bundle = both
    alone = json.loads(vla("inspect", case.bundle, "--json").out)
    shown = json.loads(vla("inspect", bundle, "--embodiment", tag, "--json").out)
    assert shown["embodiments"] == [OTHER, tag] and shown["bundle"]["embodiment"] == tag
    for part in ("stats", "modules", "memory_bytes"):
        assert shown[part] == alone[part]
    checksums = {keys.pop("vla.checksum") for keys in (shown["keys"], alone["keys"])}
    assert shown["keys"] == alone["keys"] and len(checksums) == 2
    text = vla("inspect", bundle, "--embodiment", OTHER).out
    assert f"embodiment   {OTHER}, one of {OTHER}, {tag}\n" in text and "ego_view" in text

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Several robots at one server, and in one process: every act names its own."""

import numpy as np
import pytest
from convert_and_run_test import convert
from golden_cases import Golden
from server_process import SECONDS, Server

import vla_cpp
from vla_cpp.control import ChunkLoop

CASE, OTHER = "gr00t_n1_7/libero", "new_embodiment"
TAG = Golden(CASE).said["embodiment"]


@pytest.fixture(scope="module")
def bundles(tmp_path_factory):
    """{tags: a case with the bundle of these robots}"""
    found = {}
    for tags in (f"{TAG},{OTHER}", TAG, OTHER):
        found[tags] = case = Golden(CASE)
        case.said["embodiment"] = tags
        case.bundle = convert(case, tmp_path_factory.mktemp("robots") / "policy.gguf", "bf16")
    return found


@pytest.fixture(scope="module")
def case(bundles):
    """Both robots, which the server has."""
    return bundles[f"{TAG},{OTHER}"]


def observation(spec):
    """Something that the robot of this spec takes."""
    rng = np.random.default_rng(7)
    return {
        "images": {view.name: rng.integers(0, 256, (view.height, view.width, 3), np.uint8) for view in spec.views},
        "state": {state.name: rng.random(state.width, np.float32) for state in spec.states},
        "text": "open the drawer",
        "seed": 11,
    }


def test_each_robot_has_the_spec_and_the_chunk_of_its_bundle_alone(policy, bundles):
    assert list(policy.spec.robots) == [TAG, OTHER]
    for tag in (TAG, OTHER, TAG):
        with vla_cpp.Policy(bundles[tag].bundle, threads=1) as alone:
            spec = policy.spec.robots[tag]
            assert spec.embodiment == tag
            for part in ("views", "states", "action_names", "horizon", "noise_rows", "d_noise", "real_time_chunking"):
                assert getattr(spec, part) == getattr(alone.spec, part)
            chunk, expected = policy.act(**observation(spec), embodiment=tag), alone.act(**observation(spec))
            assert np.asarray(chunk).tobytes() == np.asarray(expected).tobytes()
            assert chunk.names == expected.names


def test_a_control_loop_runs_one_of_the_robots(policy):
    robot = policy.robot(OTHER)
    taken = observation(robot.spec)
    first = np.asarray(policy.act(**taken, embodiment=OTHER))[0]
    for mode in ("sync", "async"):
        with ChunkLoop(robot, rate_hz=robot.spec.rate_hz or 10, replan_every=1, mode=mode, blend="replace", on_late="hold", on_note="ignore") as loop:
            loop.begin(taken)
            assert np.array_equal(loop.step(taken).values, first)
    with pytest.raises(vla_cpp.BadObservation, match=f"expected one of {TAG}, {OTHER}, found dog"):
        policy.robot("dog")


def test_the_specs_of_both_doors_are_equal(case, server):
    with vla_cpp.Client(server.address, timeout=SECONDS) as client, vla_cpp.Policy(case.bundle, threads=1) as policy:
        assert client.spec == policy.spec
        assert client.spec.views == () and client.spec.horizon == 0 and client.spec.embodiment == ""


@pytest.mark.parametrize("embodiment", [None, "", "dog", OTHER + "x"])
def test_a_robot_that_is_not_named_or_not_there_is_refused_with_the_list(policy, embodiment):
    with pytest.raises(vla_cpp.BadObservation, match=f"embodiment: expected one of {TAG}, {OTHER}, found "):
        policy.act(**observation(policy.spec.robots[TAG]), embodiment=embodiment)


@pytest.mark.parametrize("tag", ["", "dog"])
def test_the_server_itself_refuses_what_a_client_did_not_check(server, tag):
    with vla_cpp.Client(server.address, timeout=SECONDS) as client:
        spec = client.spec.robots[TAG]
        object.__setattr__(spec, "embodiment", tag)
        with pytest.raises(vla_cpp.BadObservation, match=f"expected one of {TAG}, {OTHER}, found {tag or 'none'}"):
            client.act(**observation(spec), embodiment=TAG)


def test_the_library_itself_refuses_what_the_package_did_not_check(case):
    with vla_cpp.Policy(case.bundle, threads=1) as policy:
        spec = policy.spec.robots[TAG]
        object.__setattr__(spec, "embodiment", "")
        with pytest.raises(vla_cpp.BadObservation, match=f"expected one of {TAG}, {OTHER}, found none"):
            policy.act(**observation(spec), embodiment=TAG)


def test_one_robot_that_was_chosen_at_load_needs_no_name(case, bundles):
    with vla_cpp.Policy(bundles[OTHER].bundle, threads=1) as alone:
        expected = np.asarray(alone.act(**observation(alone.spec))).tobytes()
        with pytest.raises(vla_cpp.BadObservation, match="none, since the policy is for one robot"):
            alone.act(**observation(alone.spec), embodiment=OTHER)
    server = Server(case, "--embodiment", OTHER)
    try:
        with vla_cpp.Client(server.address, timeout=SECONDS) as client, vla_cpp.Policy(
            case.bundle, threads=1, embodiment=OTHER
        ) as policy:
            assert client.spec == policy.spec and policy.spec.embodiment == OTHER and not policy.spec.robots
            for one in (client, policy):
                for name in ({}, {"embodiment": OTHER}):
                    assert np.asarray(one.act(**observation(one.spec), **name)).tobytes() == expected
                with pytest.raises(vla_cpp.BadObservation, match=f"expected one of {OTHER}, found {TAG}"):
                    one.act(**observation(one.spec), embodiment=TAG)
    finally:
        server.stop()


def test_opening_for_a_robot_that_is_not_there_is_refused_with_the_list(case):
    with pytest.raises(vla_cpp.UsageError, match=f"embodiment: expected one of {TAG}, {OTHER}, found dog"):
        vla_cpp.Policy(case.bundle, embodiment="dog")

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""A state far beyond what the policy has seen, and a policy without statistics: both are told wherever somebody looks."""

import copy
import json
import shutil

import pytest
import wire
from convert_and_run_test import convert
from serve_observe_test import scrape
from serve_test import Server

LOCAL = ("--bind", "tcp://127.0.0.1:0", "--threads", "2")


@pytest.fixture
def degrees(golden):
    """The golden case with a state that no normalization makes small."""
    case = copy.copy(golden)
    case.state = [*golden.state[:-1], 1e30]
    return case


def test_a_state_beyond_its_bound_is_told_in_the_notes_and_refused_where_that_is_asked_for(vla, golden, degrees):
    assert vla(*golden.arguments()).json()["notes"] == []
    (note,) = vla(*degrees.arguments()).json()["notes"]
    assert "1e+30, which is" in note and "when normalized; more than 10 is far from what the policy has seen" in note
    vla(*degrees.arguments(options=["--strict-state"])).refused("bad_observation", "expected at most 10 when normalized")
    assert vla(*golden.arguments(options=["--strict-state", "--json"])).json()["notes"] == []


@pytest.mark.parametrize("options, kinds, count", [((), ["chunk", "chunk"], 1), (("--strict-state",), ["chunk", "error"], 0)])
def test_a_server_counts_states_beyond_their_bound_or_refuses_them(vla, golden, degrees, options, kinds, count):
    server = Server(vla, golden.bundle, *LOCAL, "--metrics", "127.0.0.1:0", *options)
    peer = wire.Peer(server.ready["address"])
    try:
        assert [wire.kind(peer.ask(wire.act(i, case, seed=1))) for i, case in enumerate([golden, degrees])] == kinds
        answered = "vla_requests_total", (("code", "bad_observation" if options else "ok"), ("kind", "act"))
        found = scrape(server, lambda found: found.get(answered) == (1 if options else 2))
        assert found["vla_state_beyond_total", ()] == count
    finally:
        peer.close()
        server.process.kill()
        server.process.communicate()


def test_the_bound_is_what_the_converter_was_told(vla, golden, tmp_path):
    case = copy.copy(golden)
    case.said = {**golden.said, "state_bound": 1e9}
    case.state = [*golden.state[:-1], 1e4]
    (note,) = vla(*case.arguments()).json()["notes"]
    assert "more than 10 is far" in note
    case.bundle = convert(case, tmp_path / "policy.gguf", "bf16")
    assert vla(*case.arguments()).json()["notes"] == []
    assert json.loads(vla("inspect", case.bundle, "--json").out)["keys"]["observation.state_bound"] == 1e9


@pytest.fixture
def degraded(golden, tmp_path):
    """The bundle of the golden checkpoint without statistics of its state."""
    case = copy.copy(golden)
    case.folder = tmp_path / "case"
    shutil.copytree(golden.folder / "checkpoint", case.folder / "checkpoint")
    for file in (case.folder / "checkpoint").glob("policy_preprocessor.json"):
        pipeline = json.loads(file.read_text())
        for step in pipeline["steps"]:
            if step["registry_name"] == "normalizer_processor":
                step.pop("state_file")
        file.write_text(json.dumps(pipeline))
    case.said = {**golden.said, "identity_stats": "observation.state"}
    case.bundle = convert(case, tmp_path / "policy.gguf", "bf16")
    return case


def test_a_policy_whose_state_passes_unnormalized_says_degraded_everywhere(vla, degraded):
    assert "DEGRADED     observation.state passes unnormalized" in vla("inspect", degraded.bundle).out
    (note,) = vla(*degraded.arguments()).json()["notes"]
    assert note.startswith("DEGRADED: observation.state passes unnormalized")
    server = Server(vla, degraded.bundle, *LOCAL)
    try:
        assert server.ready["DEGRADED"] == "observation.state"
    finally:
        server.process.kill()
        server.process.communicate()

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Moments that a client keeps for a policy that reads several."""

from dataclasses import replace

import numpy as np
import pytest

import vla_cpp
from vla_cpp.spec import BundleInfo, Spec, StateSpec, ViewSpec

ONE = Spec((), 0, (), ("x",), ("",), 4, 1, 1, 4, "normal", 10.0, BundleInfo("b.gguf", "diffusion", "xxh3:1", ""), "", "", "")


def spec(n_moment, *states):
    suffixes = [f"@-{k}" for k in range(n_moment - 1, 0, -1)] + [""]
    views = tuple(ViewSpec("observation.images.top" + suffix, False, 84, 84) for suffix in suffixes)
    return replace(ONE, views=views, states=tuple(StateSpec(name + suffix, 2) for name in states for suffix in suffixes))


def test_the_first_moment_stands_for_those_before_it_and_the_oldest_leaves():
    history = vla_cpp.History(spec(3, "observation.state"))
    history.add({"top": "a"}, [1, 1])
    assert history.observation == {
        "images": {"top": "a", "top@-1": "a", "top@-2": "a"},
        "state": {f"observation.state{k}": [1, 1] for k in ("", "@-1", "@-2")},
    }
    for name, x in (("b", 2), ("c", 3), ("d", 4)):
        history.add({"top": name}, {"state": np.full(2, x)})
    assert history.observation["images"] == {"top": "d", "top@-1": "c", "top@-2": "b"}
    assert {name: value[0] for name, value in history.observation["state"].items()} == {"state": 4, "state@-1": 3, "state@-2": 2}
    history.reset()
    history.add({"top": "e"}, [5, 5])
    assert set(history.observation["images"].values()) == {"e"}


def test_a_policy_of_one_moment_gets_what_was_given_last():
    history = vla_cpp.History(spec(1, "observation.state"))
    for name in "ab":
        history.add({"top": name}, [1, 2])
    assert history.observation == {"images": {"top": "b"}, "state": {"observation.state": [1, 2]}}


def test_nothing_seen_and_a_state_that_could_be_several_are_refused():
    history = vla_cpp.History(spec(2, "observation.state", "observation.environment_state"))
    with pytest.raises(vla_cpp.BadObservation, match="history: expected a moment or more"):
        history.observation  # noqa: B018
    with pytest.raises(vla_cpp.BadObservation, match="a dict of observation.state, observation.environment_state"):
        history.add({"top": "a"}, [1, 2])
    with pytest.raises(vla_cpp.BadObservation, match="images"):
        history.add(None, {"state": [1], "environment_state": [2]})

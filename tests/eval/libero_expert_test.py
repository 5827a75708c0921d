# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The expert of examples/libero and what its demonstrations become: against a recorded episode, without the simulator, and in it."""

import importlib.util
import sys
from pathlib import Path
from types import SimpleNamespace

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
    chunk, valid = collect.chunks(actions, 8, collect.HORIZON)
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
    assert str(arrays["sentence"]) == libero.SENTENCES["libero_object/2"]
    assert np.abs(thing[:2] - basket[:2]).max() < 0.1 and arrays["image"].shape == (len(arrays["state"]), 128, 128, 3)
    again = collect.demonstration(scene, 10001, 4)
    for key in ("state", "place"):  # a soft reset keeps a trace of what went before
        assert again[key][0] == pytest.approx(arrays[key][0], abs=2e-3)
    scene.close()


def need(*modules):
    for module in modules:
        if importlib.util.find_spec(module) is None:
            pytest.skip(f"{module} is not installed here: see 'Set up' in examples/metaworld/README.md")


def episode_file(path, n, every=1):
    rng = np.random.default_rng(n)
    action, valid = collect.chunks([rng.uniform(-1, 1, 7).astype(np.float32) for _ in range(n)], every, collect.HORIZON)
    rows = len(action)
    frames = {view: rng.integers(0, 255, (rows, 128, 128, 3), dtype=np.uint8) for view in ("image", "image2")}
    state, place = rng.normal(size=(rows, 8)).astype(np.float32), rng.normal(size=(rows, 6)).astype(np.float32)
    arrays = {**frames, "state": state, "action": action, "valid": valid, "place": place, "sentence": libero.SENTENCES["libero_object/2"]}
    np.savez(path, **arrays)
    return arrays


def test_lerobot_reads_the_demonstrations(tmp_path):
    need("torch", "lerobot", "datasets")
    import dataset
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    (tmp_path / "steps").mkdir()
    episodes = [episode_file(tmp_path / f"steps/{n}.npz", n) for n in (5, 7)]
    dataset.write(sorted((tmp_path / "steps").glob("*.npz")), tmp_path / "dataset")
    read = LeRobotDataset("dataset", root=tmp_path / "dataset", delta_timestamps={"action": [i / dataset.RATE_HZ for i in range(16)]})
    assert read.meta.total_episodes == 2 and len(read) == 12
    for i, row in enumerate(episodes[1]["action"]):
        item = read[5 + i]
        assert item["action"].numpy() == pytest.approx(row) and item["task"] == libero.SENTENCES["libero_object/2"]
        assert item["action_is_pad"].tolist() == (~episodes[1]["valid"][i]).tolist()
        assert (item["observation.images.image2"].permute(1, 2, 0).numpy() * 255).round().astype(np.uint8).tobytes() == episodes[1]["image2"][i].tobytes()
    gaps = episode_file(tmp_path / "gaps.npz", 9, every=4)
    with pytest.raises(SystemExit, match="collect with --every 1"):
        list(dataset.rows(gaps))


def test_training_reads_what_was_added_and_asks_for_demonstrations(tmp_path):
    need("torch", "lerobot")
    import train

    with pytest.raises(SystemExit, match="no demonstrations in .*: run  python collect.py"):
        train.Demonstrations(tmp_path)
    first, second = (episode_file(tmp_path / f"{n}.npz", n) for n in (5, 7))
    (tmp_path / "7.npz").rename(tmp_path / "7")
    data = train.Demonstrations(tmp_path)
    assert (data.episodes(), len(data.state), len(data.sentence)) == (1, 5, 5)
    (tmp_path / "7").rename(tmp_path / "7.npz")
    for _ in range(2):
        data.read()
        assert (data.episodes(), len(data.sentence)) == (2, 12)
        assert data.state.numpy().tolist() == [*first["state"].tolist(), *second["state"].tolist()]
        assert data.frames["image2"][5:].numpy().tobytes() == second["image2"].tobytes()
        assert data.pad.tolist() == (~np.concatenate([first["valid"], second["valid"]])).tolist()


def test_the_training_loss_is_lerobots(tmp_path):
    """One draw, the same noise: what the expert is trained on is what LeRobot's own forward computes."""
    need("torch", "lerobot")
    import torch
    import train

    episode_file(tmp_path / "0.npz", 6)
    data = train.Demonstrations(tmp_path)
    options = SimpleNamespace(out=tmp_path, seed=0, rate=1e-3, batch=4, draws=3, minutes=1.0, steps=4, place=0.5, autocast=False)
    training = train.Training(options, data)
    raw = data.batch(torch.arange(4), torch.Generator().manual_seed(1))
    pad, place = torch.zeros(4, 16, dtype=torch.bool), torch.zeros(4, 6)
    torch.manual_seed(5)
    flow, _ = train.losses(training.policy, training.asked, training.before(dict(raw)), pad, place, 1)
    torch.manual_seed(5)
    own, _ = training.policy.forward({**training.before(dict(raw)), "action_is_pad": pad})
    assert flow.item() == pytest.approx(own.item(), rel=1e-5)
    before = training.policy.state_dict()["model.action_in_proj.weight"].clone()
    training.improve(torch.arange(4))
    training.keep()
    again = train.Training(options, data)
    assert again.step == 1 and not torch.equal(before, again.policy.state_dict()["model.action_in_proj.weight"])
    assert all(torch.equal(x, y) for x, y in zip(training.mean.state_dict().values(), again.mean.state_dict().values()))

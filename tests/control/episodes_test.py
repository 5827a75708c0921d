# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Episodes come back equal, whatever ends their writing, and LeRobot reads and trains on what is exported of them."""

import io
import json
import math
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from vla_cpp import BadObservation, BadRequest, BundleInfo, IoError, Spec, StateSpec, UsageError, ViewSpec
from vla_cpp.control import Action, Episode, EpisodeWriter
from vla_cpp.control.episodes import FRAMES, HEADER, episodes_of
from vla_cpp.export.cli import main

SPEC = Spec(
    views=(ViewSpec("observation.images.top", False, 64, 64, ()), ViewSpec("observation.images.wrist", True, 64, 64, ())), min_views=1,
    states=(StateSpec("observation.state", 3, ("", "", ""), ("a", "b", "c")),), action_names=("x", "y"), action_units=("", ""), horizon=4,
    d_action=2, d_noise=2, noise_rows=4, noise="normal", rate_hz=20.0, bundle=BundleInfo("b.gguf", "act", "xxh3:1", ""), precision="",
    kernels="", device="",
)  # fmt: skip
TOP, STATE = "observation.images.top", "observation.state"


def seen(i, size=(48, 64)):
    rng = np.random.default_rng(i)
    return {"images": {"top": rng.integers(0, 256, (*size, 3), np.uint8), "wrist": None}, "state": rng.uniform(-1, 1, 3).astype(np.float32)}


def action(i, human=False, held=False, values=True):
    row = np.array([i, -i], np.float32)
    return Action(row if values else None, i, held, human=human, policy=row + 1 if human else None)


def write(folder, n=6, human=(2, 3), success=True, text="open the drawer"):
    with EpisodeWriter(folder, SPEC, 20) as episodes:
        episodes.begin(text)
        for i in range(n):
            episodes.add(seen(i), action(i, human=i in human, held=i == 1, values=i > 0))
        episodes.end(success)


def test_frames_come_back_equal(tmp_path):
    write(tmp_path)
    (episode,) = episodes_of(tmp_path)
    header = episode.header
    assert (header.text, header.rate_hz, header.success, header.checksum) == ("open the drawer", 20, True, "xxh3:1")
    assert header.images == {TOP: (48, 64)} and header.states == {STATE: ("a", "b", "c")} and header.action_names == ("x", "y")
    frames = list(episode)
    assert episode.n_frame == len(frames) == 6 and not episode.is_cut
    for i, frame in enumerate(frames):
        assert (frame[f"image {TOP}"] == seen(i)["images"]["top"]).all() and (frame[f"state {STATE}"] == seen(i)["state"]).all()
        assert frame["tick"] == i and frame["human"] == (i in (2, 3)) and frame["held"] == (i == 1)
    assert np.isnan(frames[0]["action"]).all() and frames[2]["action"].tolist() == [2, -2]
    assert np.isnan(frames[1]["policy"]).all()  # held: it wanted nothing
    assert frames[2]["policy"].tolist() == [3, -1] and frames[4]["policy"].tolist() == [4, -4]


def test_a_picture_file_is_kept_as_its_pixels(tmp_path):
    data = io.BytesIO()
    Image.fromarray(seen(0)["images"]["top"]).save(data, "PNG")
    with EpisodeWriter(tmp_path, SPEC, 20) as episodes:
        episodes.begin("go")
        episodes.add({"images": {"top": data.getvalue()}, "state": np.zeros(3)}, action(1))
    (episode,) = episodes_of(tmp_path)
    assert (next(iter(episode))[f"image {TOP}"] == seen(0)["images"]["top"]).all() and episode.header.success is None


def test_episodes_are_numbered_and_an_empty_one_is_none(tmp_path):
    write(tmp_path, text="one")
    with EpisodeWriter(tmp_path, SPEC, 20) as episodes:
        episodes.begin("nothing")
        episodes.end(None)
        episodes.begin("two")
        episodes.add(seen(0), action(1))
    assert [e.header.text for e in episodes_of(tmp_path)] == ["one", "two"]


@pytest.mark.parametrize("change", [dict(images={"top": np.zeros((9, 9, 3), np.uint8)}), dict(images={}), dict(images={"top": np.zeros((48, 64), np.uint8)})])
def test_a_frame_of_another_kind_is_refused_and_the_next_is_taken(tmp_path, change):
    with EpisodeWriter(tmp_path, SPEC, 20) as episodes:
        episodes.begin("go")
        episodes.add(seen(0), action(0))
        with pytest.raises(BadObservation):
            episodes.add({**seen(1), **change}, action(1))
        episodes.add(seen(2), action(2))
    assert [frame["tick"] for frame in episodes_of(tmp_path)[0]] == [0, 2]


def test_calls_in_another_order_are_refused(tmp_path):
    episodes = EpisodeWriter(tmp_path, SPEC, 20)
    with pytest.raises(UsageError, match="begin first"):
        episodes.add(seen(0), action(0))
    with pytest.raises(UsageError, match="an episode"):
        episodes.end(True)
    episodes.begin("go")
    with pytest.raises(UsageError, match="goes on"):
        episodes.begin("go")
    with pytest.raises(UsageError):
        EpisodeWriter(tmp_path, SPEC, math.nan)


def test_a_killed_writer_leaves_whole_frames(tmp_path):
    program = (
        "import os, signal, sys, time; sys.path[:0] = %r\nfrom episodes_test import *\nepisodes = EpisodeWriter(%r, SPEC, 20)\nepisodes.begin('go')\n"
        "for i in range(20): episodes.add(seen(i), action(i))\ntime.sleep(1)\nos.kill(os.getpid(), signal.SIGKILL)\n"
    ) % ([str(Path(__file__).parent), str(Path(__file__).resolve().parents[2] / "python")], str(tmp_path))
    assert subprocess.run([sys.executable, "-c", program]).returncode == -signal.SIGKILL
    (episode,) = episodes_of(tmp_path)
    assert [frame["tick"] for frame in episode] == list(range(20)) and episode.header.success is None
    with open(episode.folder / FRAMES, "ab") as file:
        file.write(b"half a frame")
    (cut,) = episodes_of(tmp_path)
    assert cut.is_cut and cut.n_frame == 20


def test_a_full_disk_is_told_and_the_next_episode_is_written(tmp_path):
    """A limit on the size of files stands for it; the frames before stay."""
    program = (
        "import resource, signal, sys; sys.path[:0] = %r\nfrom episodes_test import *\nsignal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, -1))\nepisodes = EpisodeWriter(%r, SPEC, 20)\nepisodes.begin('go')\n"
        "try:\n  for i in range(50): episodes.add(seen(i), action(i))\n  episodes.end(True)\n"
        "except IoError as error: print(error)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (-1, -1))\n"
        "try: episodes.close()\nexcept IoError: pass\n"
        "episodes.begin('again')\nfor i in range(30): episodes.add(seen(i), action(i))\nepisodes.end(True)\nsys.exit(3)\n"
    ) % ([str(Path(__file__).parent), str(Path(__file__).resolve().parents[2] / "python")], str(tmp_path))
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 3 and "a disk that takes frames" in done.stdout, done.stderr
    episode, again = episodes_of(tmp_path)
    assert episode.n_frame > 5 and [frame["tick"] for frame in episode] == list(range(episode.n_frame))
    assert again.n_frame == 30 and again.header.success  # of a disk that has room again


@pytest.mark.parametrize(
    "change",
    [
        {"format": "vla-episode 2"}, {"rate_hz": 0}, {"rate_hz": "20"}, {"images": {TOP: [0, 5]}}, {"images": {TOP: [5]}}, {"images": 3}, {"text": 1},
        {"states": {"s": [1]}}, {"action_names": []}, {"success": "yes"}, {"more": 1}, {"images": {TOP: [60000, 60000]}},
    ],
)  # fmt: skip
def test_a_damaged_header_is_refused(tmp_path, change):
    write(tmp_path)
    path = tmp_path / "episode_000000" / HEADER
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    with pytest.raises(BadRequest, match="header"):
        Episode(path.parent)


@pytest.mark.parametrize("text", ["", "[]", "{", "null", "[" * 100000, '{"format": NaN}'])
def test_a_header_that_is_no_json_is_refused(tmp_path, text):
    write(tmp_path)
    path = tmp_path / "episode_000000" / HEADER
    path.write_text(text)
    with pytest.raises(BadRequest, match="header"):
        Episode(path.parent)


def test_what_is_no_episode_is_refused(tmp_path):
    with pytest.raises(UsageError, match="none"):
        episodes_of(tmp_path)
    write(tmp_path)
    os.remove(tmp_path / "episode_000000" / FRAMES)
    with pytest.raises(IoError):
        episodes_of(tmp_path)


# --- LeRobot --------------------------------------------------------------------------------------------------------------------


def exported(folder, *options):
    assert main([str(folder), "--lerobot", str(folder / "data"), *options]) == 0
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    return LeRobotDataset("data", root=folder / "data")


def test_lerobot_reads_back_equal(tmp_path):
    pytest.importorskip("lerobot.datasets.lerobot_dataset", exc_type=ImportError)
    write(tmp_path)
    write(tmp_path, n=3, human=(), success=False, text="close it")
    data = exported(tmp_path)
    assert data.num_frames == 7 and data.num_episodes == 2 and data.fps == 20  # the first tick had no command
    for at, (i, human, success) in enumerate([(1, 0, 0), (2, 1, 0), (3, 1, 0), (4, 0, 0), (5, 0, 1), (1, 0, 0), (2, 0, 0)]):
        frame = data[at]
        assert (np.round(frame[TOP].numpy() * 255).astype(np.uint8).transpose(1, 2, 0) == seen(i)["images"]["top"]).all()
        assert (frame[STATE].numpy() == seen(i)["state"]).all() and frame["action"].tolist() == [i, -i]
        assert bool(frame["intervention"]) == bool(human) and bool(frame["next.success"]) == bool(success)
        assert frame["task"] == ("open the drawer" if at < 5 else "close it")
    assert data[1]["action.policy"].tolist() == [3, -1] and np.isnan(data[0]["action.policy"].numpy()).all()


def test_corrections_alone(tmp_path):
    pytest.importorskip("lerobot.datasets.lerobot_dataset", exc_type=ImportError)
    write(tmp_path, n=8, human=(2, 3, 6))
    data = exported(tmp_path, "--only-interventions")
    assert data.num_frames == 3 and data.num_episodes == 2 and [data[i]["action"][0].item() for i in range(3)] == [2, 3, 6]


def test_act_trains_a_step_on_it(tmp_path):
    pytest.importorskip("lerobot.datasets.lerobot_dataset", exc_type=ImportError)
    pytest.importorskip("lerobot.policies.act.modeling_act", exc_type=ImportError)
    import torch
    from lerobot.configs.types import FeatureType, PolicyFeature
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.policies.act.modeling_act import ACTPolicy

    write(tmp_path, n=12)
    exported(tmp_path)
    data = LeRobotDataset("data", root=tmp_path / "data", delta_timestamps={"action": [i / 20 for i in range(4)]})
    config = ACTConfig(
        chunk_size=4, n_action_steps=4, dim_model=32, n_heads=2, dim_feedforward=32, n_encoder_layers=1, n_vae_encoder_layers=1, latent_dim=4,
        pretrained_backbone_weights=None, device="cpu",
        input_features={TOP: PolicyFeature(FeatureType.VISUAL, (3, 48, 64)), STATE: PolicyFeature(FeatureType.STATE, (3,))},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (2,))},
    )  # fmt: skip
    policy = ACTPolicy(config)
    batch = next(iter(torch.utils.data.DataLoader(data, batch_size=4)))
    optimizer = torch.optim.SGD(policy.parameters(), 1e-3)
    losses = []
    for _ in range(3):
        loss, _ = policy.forward(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert all(math.isfinite(loss) for loss in losses)


def test_wrong_options_are_told(tmp_path, capsys):
    write(tmp_path)
    for arguments in (["--mcap", str(tmp_path / "x")], ["--lerobot", str(tmp_path / "x"), "--fps", "5"]):
        assert main([str(tmp_path), *arguments]) == 2 and "--lerobot alone" in capsys.readouterr().err
    (tmp_path / "empty").mkdir()
    assert main([str(tmp_path / "empty"), "--lerobot", str(tmp_path / "x"), "--only-interventions"]) == 2
    assert "episodes of a control loop" in capsys.readouterr().err

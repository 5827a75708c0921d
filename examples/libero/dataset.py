# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Writes demonstrations as a data set of LeRobot, which lerobot-train and lerobot-dataset-viz read.

    python collect.py --out steps --every 1 --demos 6       # every step: a data set has no gaps
    python dataset.py steps --out dataset

One row a step, 20 a second: both cameras (128 x 128, PNG), the state, the expert's clean action and the sentence.
"""

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import small_smolvla as small  # noqa: E402  (before lerobot)
import numpy as np  # noqa: E402
from collect import ACTION_NAMES, RATE_HZ, STATE_NAMES, VIEWS  # noqa: E402


def features(side):
    frames = {f"observation.images.{view}": {"dtype": "image", "shape": (side, side, 3), "names": ["height", "width", "channels"]} for view in VIEWS}
    return small.features(STATE_NAMES, ACTION_NAMES) | frames


def rows(episode):
    """What LeRobot's writer takes, step by step. Errors: SystemExit where steps are missing between the frames."""
    if not np.array_equal(episode["action"][1:, 0], episode["action"][:-1, 1]):
        raise SystemExit("frames of some steps only: collect with --every 1")
    for i, state in enumerate(episode["state"]):
        frames = {f"observation.images.{view}": episode[view][i] for view in VIEWS}
        yield {**frames, "observation.state": state, "action": episode["action"][i, 0], "task": str(episode["sentence"])}


def write(files, out):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = None
    for path in files:
        with np.load(path) as file:
            episode = dict(file)
        if dataset is None:
            side = episode["image"].shape[1]
            dataset = LeRobotDataset.create(out.name, fps=RATE_HZ, features=features(side), root=out, robot_type="panda", use_videos=False)
        for row in rows(episode):
            dataset.add_frame(row)
        dataset.save_episode()
    dataset.finalize()
    return dataset


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="the folder that collect.py filled")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="a new folder")
    a = parser.parse_args()
    files = sorted(a.data.glob("*.npz"))
    if not files:
        raise SystemExit(f"no demonstrations in {a.data}")
    dataset = write(files, a.out)
    print(f"{a.out}: {dataset.meta.total_episodes} episodes, {dataset.meta.total_frames} steps, {dataset.meta.total_tasks} sentences")
    return 0


if __name__ == "__main__":
    sys.exit(main())

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What training and recording need of the simulated robot, beside the adapter that evaluation uses.

    scene = Scene("faucet-open")
    scene.reset(seed=900000)
    frame, state = scene.frame(), scene.state()     # (128, 128, 3) uint8, (4,) float32
    success = scene.step(action)                    # action (4,) float32 in [-1, 1]
    action = scene.expert()                         # what the scripted expert would do now, (4,) float32
    draw = noise(seed=900000, replan=0)             # (16, 8) float32: where the policy's flow starts, fixed by the seed
"""
import numpy as np

from vla_cpp.eval.environments import MissingSimulator
from vla_cpp.eval.environments.metaworld import CAMERA, LIMIT, RATE_HZ, SENTENCES, SIZE, MetaWorld
from vla_cpp.eval.episode import noise_of

TASKS = SENTENCES
HORIZON, EXECUTE = 16, MetaWorld.declaration.replan_every  # steps in a chunk, and how many of them are executed
UNSEEN = 900000  # seeds from here on are never used for training
STATE_NAMES = ["hand_x", "hand_y", "hand_z", "gripper"]
ACTION_NAMES = ["dx", "dy", "dz", "gripper"]

__all__ = ["ACTION_NAMES", "CAMERA", "EXECUTE", "HORIZON", "LIMIT", "RATE_HZ", "SIZE", "STATE_NAMES", "TASKS", "UNSEEN", "Scene", "noise"]


class Scene(MetaWorld):
    """One task; ends the script where there is no simulator or no such task."""

    def __init__(self, task: str) -> None:
        if task not in TASKS:
            raise SystemExit(f"unknown task '{task}'; there are: {', '.join(TASKS)}")
        try:
            super().__init__(task)
        except MissingSimulator as e:
            raise SystemExit(str(e)) from e


def noise(seed: int, replan: int) -> np.ndarray:
    """(16, 8) float32: the starting noise of one chunk."""
    return noise_of(seed, replan, HORIZON, 8)

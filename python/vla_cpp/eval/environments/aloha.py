# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""ALOHA in gym-aloha: two ViperX arms over a table; the right one picks up a cube and hands it to the left one.

State and action: six joints in radians and the gripper (0 closed, 1 open) of the left arm, then of the right one; an action is
where they are to be. Seed s puts the cube where gym-aloha's `sample_box_pose(s)` puts it. The task is solved when the left gripper
touches the cube and the table does not (reward 4 of gym_aloha/tasks/sim.py).
Physics, task and reward are gym-aloha's own (gym_aloha/env.py, whose steps also draw three cameras of 480 x 640); only `top` is
drawn, when the policy looks, without shadows and multisampling, which take nine tenths of the time.
"""

from __future__ import annotations

from typing import Any, Dict, List

import numpy as np

from ..environment import Declaration, Environment, Observation
from . import MissingSimulator
from .metaworld import choose_renderer

CAMERA = "top"
HEIGHT, WIDTH = 96, 128
LIMIT = 400  # steps of LeRobot's episodes
RATE_HZ = 50.0
SUBSTEPS = 10  # of 2 ms
SOLVED = 4  # reward
SENTENCE = "pick up the cube with the right arm and transfer it to the left arm"
JOINTS = ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate", "gripper")
NAMES = tuple(f"{side}_{joint}" for side in ("left", "right") for joint in JOINTS)


def _import() -> Any:
    choose_renderer()  # before MuJoCo, which reads it once
    try:
        from dm_control import mujoco
        from gym_aloha.constants import ASSETS_DIR
        from gym_aloha.tasks import sim
        from gym_aloha.utils import sample_box_pose
    except ImportError as error:
        raise MissingSimulator(f"{error}: pip install gym-aloha==0.1.5 mujoco==3.8.1") from error
    return mujoco, str(ASSETS_DIR / "bimanual_viperx_transfer_cube.xml"), sim, sample_box_pose


class Aloha(Environment):
    """The transfer of the cube."""

    name = "aloha"
    declaration = Declaration(
        views={CAMERA: (HEIGHT, WIDTH)},
        states={"observation.state": 14},
        d_action=14,
        low=-float(np.float32(np.pi)),
        high=float(np.float32(np.pi)),
        rate_hz=RATE_HZ,
        limit=LIMIT,
        replan_every=25,
        conventions="top camera without shadows. State and action: six joints in radians and the gripper (0 closed, 1 open), left arm first.",
    )

    def __init__(self, task: str) -> None:
        mujoco, scene, self._sim, self._sample = _import()
        self.task = task
        self.physics = mujoco.Physics.from_xml_path(scene)
        self.physics.model.vis.quality.shadowsize = self.physics.model.vis.quality.offsamples = 0
        self._cube = self._sim.TransferCubeTask()

    @classmethod
    def tasks(cls) -> List[str]:
        return ["transfer_cube"]

    def instruction(self) -> str:
        return SENTENCE

    def reset(self, seed: int) -> None:
        self._sim.BOX_POSE[0] = self._sample(seed)
        self._cube.initialize_episode(self.physics)
        self.reward = 0

    def observe(self) -> Observation:
        return Observation({CAMERA: self.drawn(HEIGHT, WIDTH)}, {"observation.state": self.state()})

    def state(self) -> np.ndarray:
        """(14,) float32: joints in radians and grippers in [0, 1]."""
        return np.asarray(self._cube.get_qpos(self.physics), np.float32)

    def cube(self) -> np.ndarray:
        """(3,) metres: where the cube is, which no policy is told."""
        return np.array(self._cube.get_env_state(self.physics)[:3])

    def drawn(self, height: int, width: int) -> np.ndarray:
        """(height, width, 3) uint8 RGB."""
        return np.ascontiguousarray(self.physics.render(height=height, width=width, camera_id=CAMERA))

    def picture(self) -> np.ndarray:
        """The same for a film."""
        return self.drawn(360, 480)

    def step(self, action: np.ndarray) -> bool:
        self._cube.before_step(np.asarray(action, np.float64), self.physics)
        self.physics.step(SUBSTEPS)
        self.reward = max(self.reward, self._cube.get_reward(self.physics))
        return self.reward == SOLVED

    def close(self) -> None:
        self.physics.free()  # the renderer too, whose thread would otherwise complain at the end of the process

    def facts(self) -> Dict[str, float]:
        """What a row of results tells about the end of an episode beside success: 1 touched by the right gripper, 2 lifted, 3 touched
        by the left one, 4 handed over."""
        return {"reward": float(self.reward)}

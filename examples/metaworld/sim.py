# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The simulated robot: four MetaWorld tasks, one camera, the scripted experts.

Everything that touches MetaWorld and MuJoCo is here; the other scripts see only this:

    scene = Scene("faucet-open")
    scene.reset(seed=900000)
    frame, state = scene.frame(), scene.state()     # (128, 128, 3) uint8, (4,) float32
    success = scene.step(action)                    # action (4,) float32 in [-1, 1]
    action = scene.expert()                         # what the scripted expert would do now, (4,) float32
    draw = noise(seed=900000, replan=0)             # (16, 8) float32: where the policy's flow starts, fixed by the seed

State: x, y, z of the hand in metres and the opening of the gripper in [0, 1].
Action: dx, dy, dz of the hand in hundredths of a metre per step, and the gripper's effort (positive closes).
One step is 12.5 ms.  A seed fixes the layout: the same seed gives the same frames on the same machine.
"""
import os
import warnings
from typing import Any, List

os.environ.setdefault("MUJOCO_GL", "osmesa")  # software rendering, no display needed
os.environ.setdefault("LP_NUM_THREADS", "1")  # one render thread per process: the processes are the parallelism

import numpy as np  # noqa: E402

SIZE = 128  # pixels, both ways
LIMIT = 150  # steps after which an episode counts as failed
HORIZON, EXECUTE = 16, 8  # steps in a chunk, and how many of them are executed before the next look
CAMERA = "corner4"
RATE_HZ = 80  # control steps per second
UNSEEN = 900000  # seeds from here on are never used for training
STATE_NAMES = ["hand_x", "hand_y", "hand_z", "gripper"]
ACTION_NAMES = ["dx", "dy", "dz", "gripper"]
TASKS = {  # task -> the sentence that asks for it; the faucet pair shares its scene, so only the sentence tells them apart
    "faucet-open": "open the faucet",
    "faucet-close": "close the faucet",
    "button-press-topdown": "press the button from above",
    "drawer-close": "close the drawer",
}


_renderers: List[Any] = []  # never dropped: closing one renderer makes the next ones return noise (MuJoCo 3.3 with OSMesa)


class Scene:
    """One task with its camera and its scripted expert."""

    def __init__(self, task: str) -> None:
        try:
            import mujoco
            from metaworld.env_dict import ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE
            from metaworld.policies import ENV_POLICY_MAP
        except ImportError as e:
            raise SystemExit(f"{e}. The simulator is missing: pip install metaworld==3.1.1 packaging") from e
        if task not in TASKS:
            raise SystemExit(f"unknown task '{task}'; there are: {', '.join(TASKS)}")
        self.task, self._mujoco = task, mujoco
        self.env = ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE[f"{task}-v3-goal-observable"](seed=0)
        self.env._freeze_rand_vec = False  # draw a new layout at every reset ...
        self.env.seeded_rand_vec = True  # ... from the environment's own seed (reset(seed=...) is ignored)
        self._policy = ENV_POLICY_MAP[f"{task}-v3"]()

        # The scene asks for a 4096 px shadow map and multisampling: nine tenths of the render time on a CPU.
        model = self.env.model
        model.vis.quality.shadowsize = model.vis.quality.offsamples = 0
        model.vis.global_.offwidth = model.vis.global_.offheight = SIZE
        self._renderer = mujoco.Renderer(model, SIZE, SIZE)
        _renderers.append(self._renderer)
        self._options = mujoco.MjvOption()
        self._options.sitegroup[:] = 0  # coloured goal markers would betray the task

    def reset(self, seed: int) -> None:
        """Puts hand and object where this seed says."""
        self.env.seed(seed)
        self._obs, _ = self.env.reset()

    def state(self) -> np.ndarray:
        """(4,) float32: hand position in metres, gripper opening in [0, 1]."""
        return np.asarray(self._obs[:4], np.float32)

    def frame(self) -> np.ndarray:
        """(128, 128, 3) uint8 RGB, upright.  The camera hangs upside down, hence the half turn."""
        self._renderer.update_scene(self.env.data, camera=CAMERA, scene_option=self._options)
        flags = self._renderer.scene.flags
        flags[self._mujoco.mjtRndFlag.mjRND_SHADOW] = flags[self._mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        return np.ascontiguousarray(self._renderer.render()[::-1, ::-1])

    def expert(self) -> np.ndarray:
        """(4,) float32 in [-1, 1]: the scripted expert's action in this state.  It knows the object's true position."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it warns that it asks for more than 1; that is what the clip is for
            action = self._policy.get_action(self._obs)
        return np.clip(action, -1, 1).astype(np.float32)

    def step(self, action: np.ndarray) -> bool:
        """Executes one action (4,) in [-1, 1], clipped; returns whether the task is solved now."""
        self._obs, _, _, _, info = self.env.step(np.clip(action, -1, 1).astype(np.float32))
        return bool(info["success"])

    def turned(self) -> float:
        """How far the faucet's handle is turned, in radians: about 1.4 is open, -1.3 closed, 0 the start.  0 without a faucet."""
        return float(self.env.data.joint("knob_Joint_1").qpos[0]) if "faucet" in self.task else 0.0


def noise(seed: int, replan: int) -> np.ndarray:
    """(16, 8) float32: the starting noise of one chunk.  Every runtime gets the same, so their chunks can be compared."""
    return np.random.default_rng([seed, replan]).standard_normal((HORIZON, 8), dtype=np.float32)

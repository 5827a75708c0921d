#!/usr/bin/env python3
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""A scripted expert for ALOHA's cube, from where the simulator says that it is: poses of both grippers, joints by damped least
squares, and straight lines between them in the space of joints.

    python expert.py --episodes 50        counts how often it succeeds, without drawing
"""

import argparse

import mujoco
import numpy as np

from vla_cpp.eval.environments import make

REACH = 0.135  # metres from the gripper's link to between its finger tips
OPEN, CLOSED = 1.0, 0.0
SIDES = ("left", "right")


def pose(side, pitch, roll=0.0):
    """(3, 3): the gripper's axes, forward (down by `pitch`), across and up, turned about forward by `roll`; radians."""
    ahead = 1.0 if side == "left" else -1.0
    forward = np.array([ahead * np.cos(pitch), 0, -np.sin(pitch)])
    across = np.array([0, ahead, 0])
    up = np.cross(forward, across)
    return np.stack([forward, across * np.cos(roll) + up * np.sin(roll), up * np.cos(roll) - across * np.sin(roll)], 1)


class Arm:
    """Inverse kinematics of one arm, on a copy of the simulator's state."""

    def __init__(self, environment, side):
        self.model, self.data = environment.physics.model.ptr, mujoco.MjData(environment.physics.model.ptr)
        self.data.qpos[:] = environment.physics.data.qpos
        first = 8 * SIDES.index(side)
        self.joints = slice(first, first + 6)
        self.link = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_BODY, f"vx300s_{side}/gripper_link")

    def solve(self, position, axes, start, steps=200):
        """(6,) radians near `start` that bring the point between the finger tips to `position`, metres, with these axes."""
        self.data.qpos[self.joints] = start
        jacobian = np.zeros((6, self.model.nv))
        low, high = self.model.jnt_range[self.joints].T
        for _ in range(steps):
            mujoco.mj_kinematics(self.model, self.data)
            mujoco.mj_comPos(self.model, self.data)
            now = self.data.xmat[self.link].reshape(3, 3)
            tip = self.data.xpos[self.link] + REACH * now[:, 0]
            error = np.concatenate([position - tip, 0.5 * sum(np.cross(now[:, i], axes[:, i]) for i in range(3))])
            if np.abs(error).max() < 1e-4:
                break
            mujoco.mj_jac(self.model, self.data, jacobian[:3], jacobian[3:], tip, self.link)
            part = jacobian[:, self.joints]
            change = part.T @ np.linalg.solve(part @ part.T + 1e-4 * np.eye(6), error)
            self.data.qpos[self.joints] = np.clip(self.data.qpos[self.joints] + np.clip(change, -0.2, 0.2), low, high)
        return self.data.qpos[self.joints].copy()


class Expert:
    """Actions of an episode that begins now."""

    def __init__(self, environment):
        cube, rest = environment.cube(), environment.state().astype(float)
        meet = np.array([0.0, 0.5, 0.25])
        down = np.radians(60)
        home = {side: (rest[7 * i : 7 * i + 6], OPEN) for i, side in enumerate(SIDES)}
        self.plans = {}
        for side in SIDES:
            arm, plan = Arm(environment, side), [(0, *home[side])]

            def to(step, position, axes, gripper, plan=plan, arm=arm):
                plan.append((step, arm.solve(position, axes, plan[-1][1]), gripper))

            if side == "right":
                axes = pose(side, down)
                to(45, cube * [1, 1, 0] + [0, 0, 0.10], axes, OPEN)
                to(65, cube * [1, 1, 0] + [0, 0, 0.018], axes, OPEN)
                to(80, cube * [1, 1, 0] + [0, 0, 0.018], axes, CLOSED)
                to(130, meet, axes, CLOSED)
                to(185, meet, axes, CLOSED)
                to(195, meet, axes, OPEN)
                to(215, meet + [0.10, 0, 0.05], axes, OPEN)
            else:
                axes = pose(side, 0.0, np.pi / 2)
                to(110, meet + [-0.12, 0, -0.01], axes, OPEN)
                to(135, meet + [-0.12, 0, -0.01], axes, OPEN)
                to(165, meet + [0.01, 0, -0.01], axes, OPEN)
                to(180, meet + [0.01, 0, -0.01], axes, CLOSED)
                to(195, meet + [0.01, 0, -0.01], axes, CLOSED)
                to(230, meet + [-0.10, 0, -0.01], axes, CLOSED)
            self.plans[side] = plan
        self.step = 0

    def __call__(self):
        """(14,) float32: the next action."""
        self.step += 1
        action = []
        for side in SIDES:
            plan = self.plans[side]
            i = max(i for i, (at, *_) in enumerate(plan) if at < self.step)
            if i + 1 == len(plan):
                joints, gripper = plan[-1][1:]
            else:
                (begin, a, before), (end, b, gripper) = plan[i], plan[i + 1]
                share = (self.step - begin) / (end - begin)
                joints, gripper = a + (b - a) * share, before + (gripper - before) * share
            action += [*joints, gripper]
        return np.array(action, np.float32)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    environment = make("aloha", "transfer_cube")
    steps = []
    for seed in range(options.seed, options.seed + options.episodes):
        environment.reset(seed)
        expert = Expert(environment)
        solved = next((step for step in range(1, 260) if environment.step(expert())), None)
        steps += [solved] if solved else []
        print(f"seed {seed}, cube at {environment.cube().round(3)}: " + (f"{solved} steps" if solved else f"not solved, reward {environment.reward}"), flush=True)
    print(f"{len(steps)} of {options.episodes}" + (f", {int(np.median(steps))} steps at the median" if steps else ""))


if __name__ == "__main__":
    main()

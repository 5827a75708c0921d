# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""A scripted expert for `libero_object`: picks an object up and lets it fall into the basket. It knows where everything is.

    python expert.py [--tasks 0,1,2] [--episodes 5] [--seed 0] [--workers 2]      how often it succeeds, without drawing

It grasps from above, across the narrowest side that the fingers span, lifts, and looks whether the object came along; where it
did not, it begins again. The answer is an action of LIBERO's controller: differences in [-1, 1] and the gripper.
"""

import argparse
import multiprocessing
import os
import sys

import numpy as np
from vla_cpp.eval.demonstrations import leave
from vla_cpp.eval.environments.libero import Libero
from vla_cpp.eval.statistics import wilson

REACH, TURN = 0.05, 0.5  # metres and radians of the controller for an action of 1
SPAN = 0.07  # metres between the open fingers, with some play
ABOVE, WAY, HIGH, RELEASE = 0.12, 0.24, 0.32, 0.26  # metres: of the hand over the object; over the floor with open fingers; with an object; over the basket
LIMIT = 280


def matrix_of(quaternion):
    """(x, y, z, w) -> rotation matrix (3, 3)"""
    x, y, z, w = quaternion / np.linalg.norm(quaternion)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * (w * cross + cross @ cross)


def turn_of(matrix):
    """Rotation matrix -> its rotation vector in radians; for turns well below half a circle, where the axis is plain."""
    axis = np.array([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]]) / 2
    sine = np.linalg.norm(axis)
    return axis if sine == 0 else axis / sine * np.arctan2(sine, (np.trace(matrix) - 1) / 2)


def centre(corners):
    """(n, 3) -> (3,): the middle of the box around them"""
    return (corners.min(axis=0) + corners.max(axis=0)) / 2


class Expert:
    """Decides step by step for one episode of an environment that was reset.

    phase  what it is doing: over, down, close, lift, carry, open
    tries  grasps so far
    """

    def __init__(self, environment: Libero) -> None:
        self._env = environment
        self._object, self._basket = environment.objects()
        self.phase, self.tries, self._waited = "over", 0, 0
        self._aim()

    def act(self) -> np.ndarray:
        """(7,) float32 in [-1, 1]"""
        hand, step = self._env.sensors()["robot0_eef_pos"], getattr(self, f"_{self.phase}")
        target, closed = step(hand)
        action = np.zeros(7)
        action[:3] = (target - hand) / REACH
        action[3:6] = self._turn() / TURN
        action[6] = 1 if closed else -1
        return np.clip(action, -1, 1).astype(np.float32)

    def _enter(self, phase: str) -> None:
        self.phase, self._waited = phase, 0

    def _aim(self) -> None:
        """Where to grasp, and by which angle to turn the hand: the smallest that lets the object between the fingers."""
        corners = self._env.corners(self._object)
        angles = np.deg2rad(sorted(range(-90, 90, 10), key=abs))
        widths = [np.ptp(corners[:, :2] @ np.array([-np.sin(a), np.cos(a)])) for a in angles]
        fitting = [a for a, width in zip(angles, widths) if width < SPAN]
        self._yaw = fitting[0] if fitting else angles[int(np.argmin(widths))]
        self._grasp = centre(corners)
        self._grasp[2] = max(self._grasp[2], corners[:, 2].max() - 0.07, 0.01)  # the palm stays above a tall object

    def _turn(self) -> np.ndarray:
        """The rotation vector (world, radians) from the hand's orientation to the one that is wanted."""
        cosine, sine = np.cos(self._yaw), np.sin(self._yaw)
        wanted = np.array([[cosine, sine, 0], [sine, -cosine, 0], [0, 0, -1]])  # fingers down
        return turn_of(wanted @ matrix_of(self._env.sensors()["robot0_eef_quat"]).T)

    def _over(self, hand):
        target = self._grasp + [0, 0, ABOVE]
        if np.abs(hand[:2] - target[:2]).max() > 0.03:
            target[2] = max(target[2], WAY)  # not through what stands between
        if np.abs(hand - target).max() < 0.012 and np.linalg.norm(self._turn()) < 0.1:
            self._enter("down")
        return target, False

    def _down(self, hand):
        self._waited += 1
        if np.abs(hand - self._grasp).max() < 0.008 or self._waited > 40:
            self._enter("close")
        return self._grasp, False

    def _close(self, hand):
        self._waited += 1
        if self._waited > 12:
            self._enter("lift")
            self.tries += 1
        return self._grasp, True

    def _lift(self, hand):
        target = np.array([*self._grasp[:2], HIGH])
        if hand[2] > HIGH - 0.03:
            held = np.linalg.norm(self._place() - hand) < 0.12
            self._enter("carry" if held else "over")
            if not held:
                self._aim()
        return target, True

    def _carry(self, hand):
        basket = self._env.sensors()[f"{self._basket}_pos"]
        target = np.array([*(basket[:2] + hand[:2] - self._place()[:2]), HIGH])
        if np.linalg.norm(self._place() - hand) > 0.15:  # it fell
            self._enter("over")
            self._aim()
        elif np.abs(hand[:2] - target[:2]).max() < 0.015:
            self._enter("open")
            self._over_basket = np.array([*target[:2], RELEASE])
        return target, True

    def _open(self, hand):
        self._waited += 1
        if self._waited > 45:  # beside the basket
            self._enter("over")
            self._aim()
        return self._over_basket, self._waited < 15

    def _place(self) -> np.ndarray:
        return centre(self._env.corners(self._object))


def episode(environment: Libero, seed: int):
    """(solved, steps, grasps)"""
    environment.reset(seed)
    expert = Expert(environment)
    for i in range(LIMIT):
        if environment.step(expert.act()):
            return True, i + 1, expert.tries
    return False, LIMIT, expert.tries


def record(path):
    """One episode as arrays for tests/eval/libero_expert_test.py: what the expert looks at before each step, and its action."""
    from scipy.spatial import ConvexHull

    environment, rows = Libero("libero_object/0"), []
    environment.reset(0)
    expert, (thing, basket) = Expert(environment), environment.objects()
    for _ in range(LIMIT):
        sensors = environment.sensors()
        row = {"robot0_eef_pos": sensors["robot0_eef_pos"], "robot0_eef_quat": sensors["robot0_eef_quat"], "basket_pos": sensors[f"{basket}_pos"]}
        rows.append(row | {"corners": environment.corners(thing), "action": expert.act()})
        if environment.step(rows[-1]["action"]):
            break
    arrays = {key: np.stack([row[key] for row in rows]) for key in rows[0]}
    arrays["corners"] = arrays["corners"][:, ConvexHull(arrays["corners"][0]).vertices]  # the others decide nothing
    np.savez_compressed(path, **arrays)


def _work(tasks, seeds, results):
    for task in iter(tasks.get, None):
        environment = Libero(f"libero_object/{task}")
        for seed in seeds:
            results.put((task, seed, *episode(environment, seed), environment.instruction()))
        environment.close()
    results.put(None)
    leave(results)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", default=",".join(map(str, range(10))))
    parser.add_argument("--episodes", type=int, default=5)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--record", metavar="FILE", help="write one episode for the tests instead")
    a = parser.parse_args()
    if a.record:
        record(a.record)
        os._exit(0)  # MuJoCo's destructors print errors at a normal exit
    context = multiprocessing.get_context("spawn")
    tasks, results = context.Queue(), context.Queue()
    for task in [*a.tasks.split(","), *[None] * a.workers]:
        tasks.put(task)
    seeds = range(a.seed, a.seed + a.episodes)
    workers = [context.Process(target=_work, args=(tasks, seeds, results)) for _ in range(a.workers)]
    for worker in workers:
        worker.start()
    rows, running = [], a.workers
    while running:
        row = results.get()
        running -= row is None
        if row:
            rows.append(row)
            print(f"libero_object/{row[0]}, seed {row[1]}: {'solved' if row[2] else 'not solved'}, {row[3]} steps, {row[4]} grasps", file=sys.stderr)
    print("| task | sentence | solved | 95 % interval | median steps |\n|---|---|---:|---|---:|")
    for task in [*sorted({row[0] for row in rows}, key=int), "all"]:
        own = [row for row in rows if task in (row[0], "all")]
        k, (low, high) = sum(row[2] for row in own), wilson(sum(row[2] for row in own), len(own))
        steps = int(np.median([row[3] for row in own if row[2]] or [0]))
        print(f"| {task} | {own[0][5] if task != 'all' else ''} | {k}/{len(own)} | {100 * low:.0f} to {100 * high:.0f} % | {steps} |")
    return 0


if __name__ == "__main__":
    sys.exit(main())

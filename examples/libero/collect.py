# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Collects demonstrations of the expert in the scenes of `libero_object`: one .npz file per episode.

    python collect.py --out data                          # 36 in each of the ten scenes
    python collect.py --out data --demos 3 --processes 1

Each file holds, for every fourth step (`--every`) of one solved episode,
    image, image2  (n, 128, 128, 3) uint8  what the cameras saw: as `vla-eval` shows it but for smoothed edges, each four pixels averaged
    state          (n, 8) float32          as `vla-eval` gives it
    action         (n, 16, 7) float32      the expert's clean actions at this and the next 15 steps, in [-1, 1]
    valid          (n, 16) bool            false where the episode had already ended; the action is then the last one repeated
    place          (n, 6) float32          metres: centre of the object that was asked for, and of the basket (for training alone)

Two episodes of three ask for the scene's own object, the third for another one of those that lie there, so that the sentence
decides.  Where things lie is drawn from LIBERO's regions by the episode's seed: never one of the stored initial states, which
evaluation begins from.  The executed action carries noise that lasts for several steps, while the label is what the expert
wanted, and each episode starts with up to 15 moves in a random direction: the policy sees how to come back from mistakes.
Work that is already on disk is kept: run the same command again to continue.
"""

import argparse
import multiprocessing
import os
import sys
from pathlib import Path

import numpy as np
from expert import LIMIT, Expert, centre
from vla_cpp.eval.demonstrations import chunks, leave, reports, write
from vla_cpp.eval.environments.libero import REST, SENTENCES, SETTLE, THINGS, Libero

TASKS = len(THINGS)
SEEN = Libero.declare("libero_object/0")  # what every scene shows and takes
VIEWS, RATE_HZ = tuple(SEEN.views), int(SEEN.rate_hz)
STATE_NAMES = ["x", "y", "z", "rx", "ry", "rz", "finger_left", "finger_right"]
ACTION_NAMES = ["dx", "dy", "dz", "drx", "dry", "drz", "gripper"]
HORIZON, EXECUTE = 16, SEEN.replan_every  # steps in a chunk, and how many of them are executed
AFTER = 8  # steps kept from success on
NOISE = (0.0, 0.1, 0.25)  # standard deviation of the noise on the three displacements, one of them per episode
FIRST = 10000  # seed of the first episode of a scene
ROUND = 6  # episodes of a scene before the next one is made


class Scene(Libero):
    """A scene of `libero_object` whose things lie anew for every seed, and that may ask for any of them."""

    def __init__(self, task):
        super().__init__(task)
        self._own = self.objects()
        self._draw_fast()

    def _draw_fast(self):
        """Without multisampling, in half the time: averaging four pixels smooths edges as well."""
        import mujoco

        context, model = self._env.env.sim._render_context_offscreen, self._env.env.sim.model._model
        context.gl_ctx.make_current()
        model.vis.quality.offsamples = 0
        context.con = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_150)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, context.con)

    def reset(self, seed):
        self._env.env.hard_reset = False  # the same model again: 15 ms instead of 2 s
        self._env.seed(seed)
        self._env.reset()
        for _ in range(SETTLE):
            self._obs, _, _, _ = self._env.step(REST)

    def things(self):
        """Names of what can be asked for, the scene's own object first."""
        own, basket = self._own
        return [own, *sorted(name for name in self._env.env.objects_dict if name not in (own, basket))]

    def ask_for(self, name):
        """From now on the task is to put this thing into the basket."""
        self._env.env.obj_of_interest[:] = [name, self._own[1]]
        self._env.env.parsed_problem["goal_state"][0][1] = name
        self._sentence = SENTENCES[f"libero_object/{THINGS.index(name.rpartition('_')[0].replace('_', ' '))}"]


def asked(things, seed):
    """The thing that the episode of this seed asks for."""
    return things[1 + seed // 3 % (len(things) - 1)] if seed % 3 == 2 else things[0]


def halved(frame):
    """(256, 256, 3) uint8 -> (128, 128, 3) uint8, as a policy for 128 x 128 scales it: the mean of each four pixels."""
    h, w, _ = frame.shape
    return (frame.reshape(h // 2, 2, w // 2, 2, 3).mean((1, 3)) + 0.5).astype(np.uint8)


def demonstration(scene, seed, every):
    """One episode as arrays (see above); empty if the expert failed within the limit."""
    rng = np.random.default_rng([seed, int(scene.task.rpartition("/")[2])])
    scene.ask_for(asked(scene.things(), seed))
    scene.reset(seed)
    push = np.array([*rng.uniform(-1, 1, 3), *rng.uniform(-0.2, 0.2, 3), -1])
    for _ in range(rng.integers(0, 16)):
        scene.step(push)
    expert, sigma, noise = Expert(scene), rng.choice(NOISE), np.zeros(3)
    kept = {key: [] for key in ("image", "image2", "state", "place")}
    actions, end = [], None
    for step in range(LIMIT):
        if step % every == 0:
            seen, (thing, basket) = scene.observe(), scene.objects()
            for view, frame in seen.frames.items():
                kept[view].append(halved(frame))
            kept["state"].append(seen.state["observation.state"])
            kept["place"].append(np.concatenate([centre(scene.corners(thing)), scene.sensors()[f"{basket}_pos"]]).astype(np.float32))
        actions.append(expert.act())
        noise = 0.8 * noise + 0.6 * rng.normal(0, sigma, 3)  # stationary: its deviation stays sigma
        done = scene.step(np.clip(actions[-1] + [*noise, 0, 0, 0, 0], -1, 1))
        if done and end is None:
            end = step + AFTER
        if step + 1 == end:
            break
    if end is None:
        return {}
    action, valid = chunks(actions, every, HORIZON)
    return {key: np.stack(rows) for key, rows in kept.items()} | {"action": action, "valid": valid, "sentence": scene.instruction()}


def work(jobs, every, done):
    """One process: takes (task, seeds, files) and reports each episode."""
    os.nice(19)
    for task, episodes in iter(jobs.get, None):
        scene = Scene(f"libero_object/{task}")
        for seed, path in episodes:
            arrays = demonstration(scene, seed, every)
            if arrays:
                write(path, {"task": task, "seed": seed, **arrays})
            done.put((task, len(arrays.get("state", ()))))
        scene.close()
    leave(done)


def plan(out, demos):
    """[(task, [(seed, file), ...])] of what is not on disk, a few episodes of every scene first."""
    rounds = []
    for first in range(0, demos, ROUND):
        for task in range(TASKS):
            seeds = range(FIRST + first, FIRST + min(first + ROUND, demos))
            missing = [(seed, str(out / f"{task}-{seed}.npz")) for seed in seeds if not (out / f"{task}-{seed}.npz").exists()]
            rounds += [(task, missing)] if missing else []
    return rounds


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="where the .npz files go; about 4 MB each")
    parser.add_argument("--demos", type=int, default=36, help="episodes in each scene (default 36)")
    parser.add_argument("--every", type=int, default=4, help="steps from one kept frame to the next (default 4)")
    parser.add_argument("--processes", type=int, default=2, help="simulators side by side (default 2)")
    a = parser.parse_args()
    a.out.mkdir(parents=True, exist_ok=True)
    rounds = plan(a.out, a.demos)
    jobs = multiprocessing.get_context("spawn").Queue()
    for one in [*rounds, *[None] * a.processes]:
        jobs.put(one)
    total, failed = sum(len(episodes) for _, episodes in rounds), 0
    for count, (task, n) in enumerate(reports(work, [(jobs, a.every)] * a.processes, total), 1):
        failed += n == 0
        print(f"{count}/{total}: scene {task}, {n or 'not solved, no'} frames", flush=True)
    have = {task: len(list(a.out.glob(f"{task}-*.npz"))) for task in range(TASKS)}
    print(", ".join(f"scene {task}: {n}" for task, n in have.items()) + f"; {failed} tries failed and were left out")
    return 0


if __name__ == "__main__":
    sys.exit(main())

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Collects demonstrations of the scripted experts: one .npz file per episode.

    python collect.py --out data                          # 200 per task, 300 of the hardest: 3 minutes on 2 cores
    python collect.py --out data --demos 20 --processes 1

Each file holds, for every second step of one solved episode,
    frame   (n, 128, 128, 3) uint8    what the camera saw
    state   (n, 4) float32            hand position in metres, gripper opening
    action  (n, 16, 4) float32        the expert's clean actions at this and the next 15 steps, in [-1, 1]
    valid   (n, 16) bool              false where the episode had already ended; the action is then the last one repeated

The executed action carries noise that lasts for several steps, while the label is what the expert wanted: the policy
thus sees how to come back from mistakes.  Each episode starts with up to 11 moves in a random direction and ends 6
steps after success.  Work that is already on disk is kept: run the same command again to continue.
"""
import argparse
import sys
import zlib
from pathlib import Path
from typing import Any, Dict, List, Tuple

import numpy as np

from vla_cpp.eval.demonstrations import chunks, leave, reports, write
from sim import HORIZON, LIMIT, TASKS, Scene

STRIDE = 2  # a frame is kept every second step
AFTER = 6  # steps kept after success
NOISE = (0.0, 0.15, 0.4)  # standard deviation of the action noise, one of them per episode
DEMOS, HARD = 200, {"button-press-topdown": 300}


def demonstration(scene: Scene, seed: int) -> Dict[str, np.ndarray]:
    """One episode as arrays (see above); empty if the expert failed within the limit."""
    rng = np.random.default_rng([seed, zlib.crc32(scene.task.encode())])
    scene.reset(seed)
    push = rng.uniform(-1, 1, 4)
    for _ in range(rng.integers(0, 12)):
        scene.step(push)
    sigma, noise = rng.choice(NOISE), np.zeros(4)
    frames, states, actions, left = [], [], [], None
    for step in range(LIMIT):
        if step % STRIDE == 0:
            frames.append(scene.frame())
            states.append(scene.state())
        actions.append(scene.expert())
        noise = 0.8 * noise + 0.6 * rng.normal(0, sigma, 4)  # stationary: its deviation stays sigma
        success = scene.step(actions[-1] + noise)
        if left is None and success:
            left = AFTER
        elif left is not None:
            left -= 1
            if left == 0:
                break
    if left is None:
        return {}
    label, valid = chunks(actions, STRIDE, HORIZON)
    return {"frame": np.stack(frames), "state": np.stack(states), "action": label, "valid": valid}


def work(jobs: List[Tuple[str, int, str]], done: Any) -> None:
    """One process: makes the episodes (task, seed, file) in order and reports each."""
    scenes: Dict[str, Scene] = {}
    for task, seed, path in jobs:
        if task not in scenes:
            scenes[task] = Scene(task)
        arrays = demonstration(scenes[task], seed)
        if arrays:
            write(path, {"task": task, **arrays})
        done.put((task, len(arrays.get("frame", ()))))
    leave(done)


def main() -> int:
    ap = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ap.add_argument("--out", type=Path, required=True, metavar="DIR", help="where the .npz files go; about 2 MB each")
    ap.add_argument("--demos", type=int, help=f"episodes per task (default {DEMOS}, of button-press-topdown {HARD['button-press-topdown']})")
    ap.add_argument("--processes", type=int, default=2, help="simulators side by side (default 2)")
    a = ap.parse_args()
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    a.out.mkdir(parents=True, exist_ok=True)
    wanted = {t: a.demos or HARD.get(t, DEMOS) for t in TASKS}
    jobs = [(t, 10000 + i, str(a.out / f"{t}-{10000 + i}.npz")) for i in range(max(wanted.values())) for t in TASKS if i < wanted[t]]
    missing = [j for j in jobs if not Path(j[2]).exists()]
    with Progress(TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn()) as bar:
        row = bar.add_task("episodes", total=len(jobs), completed=len(jobs) - len(missing))
        failed = 0
        for task, n in reports(work, [(missing[i :: a.processes],) for i in range(a.processes)], len(missing)):
            failed += n == 0
            bar.update(row, advance=1, description=f"episodes ({task}: {n} frames)")
    have = {t: len(list(a.out.glob(f"{t}-*.npz"))) for t in TASKS}
    print(", ".join(f"{t} {n}" for t, n in have.items()) + f"; {failed} tries failed and were left out")
    return 0


if __name__ == "__main__":
    sys.exit(main())

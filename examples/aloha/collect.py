#!/usr/bin/env python3
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Demonstrations of the scripted expert: a file for each worker, of the episodes that succeeded.

    python collect.py --out data --episodes 400

frames (n, 96, 128, 3) uint8 and states (n, 14) float32 of every fifth step, episode and step (n,) int32, actions (episodes, 230, 14)
float32, cubes (n, 3) metres. The arms get the expert's action with noise, and the label has none, so that a policy sees how to come
back. Seeds begin at 0; evaluation takes others.
"""

import argparse
import multiprocessing
from pathlib import Path

import numpy as np
from expert import Expert

from vla_cpp.eval.environments import make
from vla_cpp.eval.environments.aloha import HEIGHT, WIDTH

STEPS, EVERY = 230, 5
NOISE, KEEPS = 0.008, 0.9  # radians that are drawn in a step; the share of a step's noise that stays in the next


def episode(environment, seed):
    """What one episode adds to the file, or None where the expert fails."""
    environment.reset(seed)
    expert, random = Expert(environment), np.random.default_rng(seed)
    seen, actions, solved, noise = [], [], False, np.zeros(14)
    for step in range(STEPS):
        if step % EVERY == 0:
            seen.append((environment.drawn(HEIGHT, WIDTH), environment.state(), step, environment.cube()))
        action = expert()
        noise = KEEPS * noise + random.normal(0, NOISE, 14)
        noise[[6, 13]] = 0  # grippers
        solved |= environment.step(action + noise)
        actions.append(action)
    return (seen, actions) if solved else None


def collect(job):
    out, seeds = job
    environment = make("aloha", "transfer_cube")
    seen, actions, episodes = [], [], []
    for seed in seeds:
        found = episode(environment, seed)
        if found:
            seen += found[0]
            episodes += [len(actions)] * len(found[0])
            actions.append(found[1])
        print(f"seed {seed}: {len(actions)} episodes, {len(seen)} frames" + ("" if found else ", this one failed"), flush=True)
    frames, states, steps, cubes = map(np.array, zip(*seen))
    np.savez(out, frames=frames, states=states, step=steps.astype(np.int32), cubes=cubes.astype(np.float32), episode=np.array(episodes, np.int32), actions=np.array(actions, np.float32))
    environment.close()


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--episodes", type=int, default=400)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    jobs = [(options.out / f"part_{i}.npz", range(i, options.episodes, options.workers)) for i in range(options.workers)]
    workers = [multiprocessing.Process(target=collect, args=(job,)) for job in jobs]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()


if __name__ == "__main__":
    main()

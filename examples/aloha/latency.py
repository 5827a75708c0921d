#!/usr/bin/env python3
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What latency costs an ALOHA arm: the cube's transfer by the C++ loop (examples/cpp/simulated.cpp) at 50 Hz, in the simulator's time.

    python latency.py --bundle policy.gguf --vla build/cpu/bin/vla --loop simulated --ms 0,150,300,500 --modes sync,async

A chunk arrives so many milliseconds after its observation, however long the policy takes. Prints a Markdown table: episodes solved with
the Wilson interval, median steps of those, and the share of periods without a new command.
"""

import argparse
import math
import multiprocessing
import subprocess

import numpy as np

from vla_cpp.eval.environments import make
from vla_cpp.eval.environments.aloha import CAMERA, LIMIT, RATE_HZ, SENTENCE
from vla_cpp.eval.statistics import wilson


class Loop:
    """The program of the C++ loop, for one episode after the other."""

    def __init__(self, program, address, mode, latency):
        command = [program, address, f"observation.images.{CAMERA}", "observation.state", SENTENCE, mode, str(latency)]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        self._now = 0.0

    def reset(self):
        self._send(b"reset\n")

    def step(self, environment):
        """(the next action or None, periods that the robot waited for it, whether it is a row of a chunk)."""
        begun = self._now
        self._send(" ".join(map(str, ["step", f"{begun:.6f}", *environment.state()])).encode() + b"\n")
        while (line := self._process.stdout.readline()) == b"look\n":
            frame = environment.observe().frames[CAMERA]
            self._send(f"{frame.shape[1]} {frame.shape[0]}\n".encode() + frame.tobytes())
        if not line:
            raise SystemExit("the loop ended")
        seconds, state, *values = line.split()
        waited = math.ceil((float(seconds) - begun) * RATE_HZ - 1e-6)  # whole periods, but for the clock's rounding
        self._now = begun + (waited + 1) / RATE_HZ
        return np.array(values, np.float32) if values else None, waited, state == b"command"

    def _send(self, data):
        self._process.stdin.write(data)
        self._process.stdin.flush()


def episode(environment, loop, seed):
    """(steps until it is solved or None, periods without a new command, periods)."""
    environment.reset(seed)
    loop.reset()
    action, held, step = environment.state(), 0, 0
    while step < LIMIT:
        new, waited, is_new = loop.step(environment)
        for _ in range(waited):
            step += 1
            if environment.step(action):
                return step, held + waited, step
        held += waited + (not is_new)
        action = action if new is None else new
        step += 1
        if environment.step(action):
            return step, held, step
    return None, held, step


def work(job):
    options, address, mode, latency, seeds, results = job
    environment = make("aloha", "transfer_cube")
    loop = Loop(options.loop, address, mode, latency)
    for seed in seeds:
        results.put(episode(environment, loop, seed))
    environment.close()
    results.put(None)


def measure(options, address, mode, ms):
    results = multiprocessing.Queue()
    seeds = range(options.seed, options.seed + options.episodes)
    jobs = [(options, address, mode, ms / 1000, seeds[i :: options.workers], results) for i in range(options.workers)]
    workers = [multiprocessing.Process(target=work, args=(job,)) for job in jobs]
    for worker in workers:
        worker.start()
    found, ended = [], 0
    while ended < len(workers):
        one = results.get()
        ended += one is None
        found += [one] if one else []
    return found


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bundle", required=True)
    parser.add_argument("--vla", default="vla")
    parser.add_argument("--loop", required=True, help="the program that examples/cpp/simulated.cpp makes")
    parser.add_argument("--ms", default="0,150,300,500", help="latencies")
    parser.add_argument("--modes", default="sync,async")
    parser.add_argument("--episodes", type=int, default=40)
    parser.add_argument("--seed", type=int, default=900000)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--kernels", default="", help="as of vla serve")
    options = parser.parse_args()
    command = [options.vla, "serve", options.bundle, "--bind", "tcp://127.0.0.1:0", "--threads", "1"]
    server = subprocess.Popen(command + (["--kernels", options.kernels] if options.kernels else []), stdout=subprocess.PIPE, text=True)
    address = next(word for word in server.stdout.readline().split() if word.startswith("address=")).partition("=")[2]
    print("| latency, ms | mode | solved | 95 % interval | median steps | periods without a new command |\n| ---: | --- | ---: | --- | ---: | ---: |")
    try:
        for ms in map(float, options.ms.split(",")):
            for mode in options.modes.split(",") if ms else ["sync"]:
                found = measure(options, address, mode, ms)
                solved = [steps for steps, *_ in found if steps]
                low, high = wilson(len(solved), len(found))
                share = sum(held for _, held, _ in found) / sum(periods for *_, periods in found)
                print(f"| {ms:.0f} | `{mode}` | {len(solved)}/{len(found)} | {100 * low:.0f} to {100 * high:.0f} % | {np.median(solved) if solved else 0:.0f} | {100 * share:.0f} % |", flush=True)
    finally:
        server.terminate()
        server.wait()


if __name__ == "__main__":
    main()

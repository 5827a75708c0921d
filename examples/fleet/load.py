#!/usr/bin/env python3
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Robots that ask at a steady rate, count what they get, and lose a server's replica meanwhile.

    python load.py openpi://127.0.0.1:8000 ../../models/metaworld-tiny.gguf --robots 6 --rate 4 --seconds 30 --kill-after 10

Each answer is compared to the bit with what the same policy gives here for the same seed, so that kernels and threads have to be those
of the engines. An act is late when the robot's next one was due before its answer, and lost when none came; the robot then connects again.
`--kill-after` ends a replica on this machine as a crash would (SIGKILL). Prints JSON; exit code 1 where an answer was wrong, an act was lost
that was not under way when the replica died, or the rate did not come back.
"""

import argparse
import collections
import json
import os
import signal
import socket
import sys
import threading
import time
from typing import List, NamedTuple, Optional, Tuple

import numpy as np

import vla_cpp

WINDOW = 1.0  # seconds, in which the rate is counted
FULL = 0.95  # of the rate before, which is full rate again


class Act(NamedTuple):
    due: float  # seconds on one clock, as the two below
    asked: float
    done: float
    kind: str  # "right", "wrong" or "lost"


def cases_of(bundle, threads, kernels, n_case):
    """Observations, and the actions of the policy in this process: pairs of arguments of `act` and bytes."""
    draw = np.random.default_rng(0)
    with vla_cpp.Policy(bundle, threads=threads, kernels=kernels) as policy:
        spec, cases = policy.spec, []
        for seed in range(n_case):
            observation = {
                "images": {view.name: draw.integers(0, 256, (view.height, view.width, 3), np.uint8) for view in spec.views},
                "state": {state.name: draw.normal(0, 0.1, state.width).astype(np.float32) for state in spec.states},
                "text": "open the faucet",
                "seed": seed,
            }
            cases.append((observation, policy.act(**observation).actions.tobytes()))
    return cases


class Robot(threading.Thread):
    """Asks `rate` times a second from `start` to `end`. `acts` is what came of it."""

    def __init__(self, address: str, cases, rate: float, start: float, end: float) -> None:
        super().__init__(daemon=True)
        self._address, self._cases, self._rate, self._start, self._end = address, cases, rate, start, end
        observation = cases[0][0]
        self._names = [f"{name}={name}" for part in ("images", "state") for name in observation[part]] + ["prompt=text"]
        self._client: Optional[vla_cpp.OpenpiClient] = None
        self.acts: List[Act] = []
        self.replica = ""  # that answered first when the robot connected: HOST:PID

    def connect(self) -> vla_cpp.OpenpiClient:
        if self._client is None:
            self._client = vla_cpp.OpenpiClient(self._address, self._names, timeout=5)
            self.replica = str(self._client.metadata.get("replica", ""))
        return self._client

    def run(self) -> None:
        n = 0
        while self._start + n / self._rate < self._end:
            due = self._start + n / self._rate
            time.sleep(max(0.0, due - time.monotonic()))
            asked = time.monotonic()
            kind = self._ask(*self._cases[n % len(self._cases)])
            done = time.monotonic()
            self.acts.append(Act(due, asked, done, kind))
            n = max(n + 1, int((done - self._start) * self._rate))  # what became due meanwhile is asked for once
        if self._client is not None:
            self._client.close()

    def _ask(self, observation, expected: bytes) -> str:
        try:
            return "right" if self.connect().act(**observation).actions.tobytes() == expected else "wrong"
        except vla_cpp.VlaError as problem:
            kind = "wrong" if isinstance(problem, (vla_cpp.Incompatible, vla_cpp.BadAction)) else "lost"
            print(f"{kind}: {problem}", file=sys.stderr)
            return kind


def kill_most_asked(robots) -> str:
    """Ends the replica that most robots ask, which must run on this machine. Its name."""
    replica = collections.Counter(robot.replica for robot in robots).most_common(1)[0][0]
    host, _, pid = replica.partition(":")
    if host != socket.gethostname() or not pid.isdigit():
        raise SystemExit(f"error: --kill-after: expected a replica on this machine, found {replica or 'none'}")
    os.kill(int(pid), signal.SIGKILL)
    return replica


def rates_of(acts: List[Act], rate: float, killed: float, end: float) -> Tuple[float, Optional[float]]:
    """Answers in time a second before the kill (median), and the seconds from the kill to the first window that has this rate and so
    have the two after it; None where there is none."""
    done = np.sort([act.done for act in acts if act.kind == "right" and act.done <= act.due + 1 / rate])

    def counted(since):
        return np.searchsorted(done, since + WINDOW) - np.searchsorted(done, since)

    start = min(act.due for act in acts)
    before = float(np.median([counted(since) for since in np.arange(start, killed - WINDOW, WINDOW)]))
    for since in np.arange(killed, end - 3 * WINDOW, 0.1):
        if all(counted(since + i * WINDOW) >= FULL * before for i in range(3)):
            return before / WINDOW, float(since - killed)
    return before / WINDOW, None


def report(acts: List[Act], rate: float, killed: Optional[float], end: float) -> dict:
    ms = [1e3 * (act.done - act.asked) for act in acts if act.kind != "lost"] or [float("nan")]
    lost = [act for act in acts if act.kind == "lost"]
    told = {
        "asked": len(acts),
        "answered": len(acts) - len(lost),
        "wrong": sum(act.kind == "wrong" for act in acts),
        "lost": len(lost),
        "late": sum(act.kind != "lost" and act.done > act.due + 1 / rate for act in acts),
        "p50_ms": round(float(np.percentile(ms, 50)), 1),
        "p99_ms": round(float(np.percentile(ms, 99)), 1),
    }
    if killed is not None:
        told["under_way_at_kill"] = sum(act.asked <= killed <= act.done for act in acts)
        told["lost_beyond"] = sum(not act.asked <= killed <= act.done for act in lost)
        told["in_time_a_second_before"], told["full_rate_after_s"] = rates_of(acts, rate, killed, end)
    return told


def drive(args) -> dict:
    cases = cases_of(args.bundle, args.threads, args.kernels, 8)
    start = time.monotonic() + 1
    end = start + args.seconds
    robots = [
        Robot(f"{args.address}/robot-{i}", cases, args.rate, start + i / args.robots / args.rate, end) for i in range(args.robots)
    ]
    for robot in robots:
        robot.connect()
        robot.start()
    killed = None
    if args.kill_after is not None:
        time.sleep(max(0.0, start + args.kill_after - time.monotonic()))
        killed, replica = time.monotonic(), kill_most_asked(robots)
        print(f"killed {replica}", file=sys.stderr)
    for robot in robots:
        robot.join()
    return report([act for robot in robots for act in robot.acts], args.rate, killed, end)


def arguments():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("address", help="openpi://HOST:PORT")
    parser.add_argument("bundle", help="the policy that the engines have")
    parser.add_argument("--threads", type=int, default=1, help="those of the engines (default 1)")
    parser.add_argument("--kernels", help="those of the engines")
    parser.add_argument("--robots", type=int, default=6, help="(default 6)")
    parser.add_argument("--rate", type=float, default=4.0, help="acts a second of each robot (default 4)")
    parser.add_argument("--seconds", type=float, default=30.0, help="(default 30)")
    parser.add_argument("--kill-after", type=float, help="seconds until a replica is killed; not given: none is")
    return parser.parse_args()


def main():
    told = drive(arguments())
    print(json.dumps(told))
    failed = told["wrong"] or told.get("lost_beyond", told["lost"]) or told.get("full_rate_after_s", 0.0) is None
    return 1 if failed else 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except vla_cpp.VlaError as error:  # of the bundle, or of the first connection
        sys.exit(f"error: {error}")

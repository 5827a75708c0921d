#!/usr/bin/env python3
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Two servers for a long time, with eight robots over all front ends, while the page is open, recordings begin and end, policies are
swapped and the process of --lerobot is killed. Prints a Markdown table.

scripts/soak.py --seconds 3600            as make soak SECONDS=3600

One server has the page and records, the other one takes orders; each has a robot of each protocol, and probes of its health. Exit code 1
where an answer is wrong, where an act is lost that was not under way at the process that was killed, or where memory, open files or
threads grow after the first minute.
"""

import argparse
import contextlib
import itertools
import json
import os
import random
import shutil
import signal
import socket
import sys
import tempfile
import threading
import time
import urllib.request
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
from attacks.lerobot import children_of
from attacks.robots import Behaved, Target

ROOT = Path(__file__).resolve().parents[1]
PACE = 3  # how many times as long the robots' periods are as in scripts/serve_attacked.py
SCALE = 2  # sides of their frames over those of the policy's views: the page has all that it keeps within a minute
WARM, WINDOW = 60, 15  # seconds after which nothing grows, and over which the medians of memory, files and threads are taken
GROWTH, GROWTH_MIB, FILES, THREADS, BACK_S, END_S = 1.05, 4, 4, 1, 2, 3  # the bars; a recording has a thread
PAGE_MIB = 96  # which the page fills
ROBOTS = ("act", "openpi", "gr00t", "lerobot")


class Watch(threading.Thread):
    """Memory, open files and threads of a server and its processes, once a second."""

    def __init__(self, target):
        super().__init__(daemon=True)
        self._target, self._over, self._start = target, threading.Event(), time.monotonic()
        self.samples = []
        self.start()

    def run(self):
        while not self._over.wait(1):
            counts = [sum(map(self._count, self._target.processes(), itertools.repeat(what))) for what in ("fd", "task")]
            self.samples.append((time.monotonic() - self._start, self._target.memory_mib(), *counts))

    @staticmethod
    def _count(pid, what):
        """None of a process that has ended."""
        with contextlib.suppress(OSError):
            return len(os.listdir(f"/proc/{pid}/{what}"))
        return 0

    def stop(self):
        self._over.set()
        self.join()

    def median(self, begin, end):
        chosen = [sample[1:] for sample in self.samples if begin <= sample[0] <= end]
        return np.median(chosen, axis=0) if chosen else np.full(3, np.nan)


def order(target, **given):
    """The answer to an order. Raises ConnectionError where it is refused."""
    with socket.socket(socket.AF_UNIX) as raw:
        raw.settimeout(60)
        raw.connect(target.control)
        raw.sendall(json.dumps(given).encode() + b"\n")
        answer = json.loads(raw.makefile().readline())
    if "error" in answer:
        raise ConnectionError(answer)


def record(target):
    """Begins a recording, or ends the one that runs."""
    parts = urlsplit(target.page)

    def ask(path, method="GET"):
        with urllib.request.urlopen(urllib.request.Request(f"http://{parts.netloc}/{path}", method=method), timeout=20) as reply:
            return json.loads(reply.read())

    state = ask(f"acts?{parts.query}&after=0")["record"]
    ask(f"record?{parts.query}&on={int(not state['on'])}", "POST")


class Disturbance(threading.Thread):
    """Does things to the servers at uneven times, until `stop`. done: how often each; failed: what did not go."""

    def __init__(self, every, *steps):
        super().__init__(daemon=True)
        self._every, self._steps, self._over = every, steps, threading.Event()
        self.done, self.failed = dict.fromkeys((step.__name__ for step in steps), 0), []
        self.start()

    def run(self):
        draw = random.Random(1)
        for step in itertools.cycle(self._steps):
            if self._over.wait(self._every * draw.uniform(0.5, 1.5)):
                return
            try:
                self.done[step.__name__] += step()
            except Exception as failure:
                self.failed.append(f"{step.__name__}: {failure!r}")

    def stop(self):
        self._over.set()
        self.join()


def soak(options, folder):
    bundles = [str(shutil.copy(options.bundle, folder / f"{name}.gguf")) for name in "ab"]
    recording = folder / "recording"
    recorded = Target(options, ["page"], ("--record", recording, "--record-paused", "--record-limit", 10_000))
    ordered = Target(options, ["control"])
    targets = {"page": recorded, "orders": ordered}

    def recordings_toggled():
        record(recorded)
        for old in sorted(recording.glob("*/"))[:-1]:  # the one that runs, or ended last, stays
            shutil.rmtree(old)
        return 1

    def policies_swapped():
        bundles.reverse()
        order(ordered, do="load", policy=options.bundle.stem, bundle=bundles[0])
        return 1

    def processes_killed():
        killed = children_of(recorded.process.pid)
        for pid in killed:
            os.kill(pid, signal.SIGKILL)
        return len(killed)

    ends = {}
    try:
        robots = {name: Behaved(target, options.patience, PACE, SCALE) for name, target in targets.items()}
        watches = {name: Watch(target) for name, target in targets.items()}
        disturbances = Disturbance(options.every, recordings_toggled, policies_swapped, processes_killed)
        times = {}

        def drive(name):
            times[name] = robots[name].watch(options.seconds, is_late=False)

        threads = [threading.Thread(target=drive, args=(name,)) for name in targets]
        [thread.start() for thread in threads]
        [thread.join() for thread in threads]
        disturbances.stop()
        [watch.stop() for watch in watches.values()]
        ends = {name: target.end() for name, target in targets.items()}
    finally:
        [target.process.kill() for name, target in targets.items() if name not in ends]
    return times, robots, watches, disturbances, ends


def report(options, times, robots, watches, disturbances, ends):
    """Prints the tables; what misses its bar."""
    found = [f"no answers at the server with {name}" for name in robots if name not in times] + disturbances.failed
    print("| server | client | answered | lost | breaks | longest break, s | p50, ms | p99, ms |\n|" + " --- |" * 8)
    for server, name in ((server, name) for server in times for name in times[server] if name != "late"):
        got, robot = times[server][name], robots[server]
        lost, breaks, back = robot.lost[name], robot.breaks[name], robot.back[name]
        print(f"| {server} | {name} | {len(got)} | {lost} | {breaks} | {back:.1f} | {np.percentile(got or [np.nan], 50):.1f} | {np.percentile(got or [np.nan], 99):.1f} |")
        most = disturbances.done["processes_killed"] if (server, name) == ("page", "lerobot") else 0
        if breaks > most or back > BACK_S * options.loose or not got:
            found.append(f"{server}, {name}: {len(got)} answered, {breaks} breaks of at most {most}, {back:.1f} s")
    warm, window = min(WARM, options.seconds / 2), min(WINDOW, options.seconds / 4)
    print("\n| server | MiB: warm, at the end | files | threads | end, s | exit status |\n|" + " --- |" * 6)
    for server, watch in watches.items():
        _, first, *_ = watch.samples[0]
        end, *_ = watch.samples[-1]
        (memory, files, threads), after = watch.median(warm, warm + window), watch.median(end - window, end)
        most = max(GROWTH * memory, first + PAGE_MIB if server == "page" else 0) + GROWTH_MIB  # it may not be full yet
        end_s, status = ends[server]
        print(f"| {server} | {memory:.1f}, {after[0]:.1f} | {files:.0f}, {after[1]:.0f} | {threads:.0f}, {after[2]:.0f} | {end_s:.1f} | {status} |")
        if not all(after <= (most, files + FILES, threads + THREADS)):
            found.append(f"{server}: memory, files or threads grow")
        if end_s > END_S * options.loose or status:
            found.append(f"{server}: ended in {end_s:.1f} s with status {status}")
    print("\n" + ", ".join(f"{n} {name.replace('_', ' ')}" for name, n in disturbances.done.items()))
    print("\n".join(["missed: " + what for what in found] or ["no bar is missed"]))
    return found


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bundle", type=Path, default=ROOT / "models/metaworld-tiny.gguf")
    parser.add_argument("--vla", type=Path, default=Path(os.environ.get("VLA_BINARY", ROOT / "build/cpu/bin/vla")))
    parser.add_argument("--threads", type=int, default=1, help="of each engine; default: 1")
    parser.add_argument("--seconds", type=float, default=120, help="default: 120")
    parser.add_argument("--every", type=float, default=4, help="seconds between two disturbances, of which every third ends a process; default: 4")
    parser.add_argument("--patience", type=float, default=5, help="seconds, after which an act is lost; default: 5")
    parser.add_argument("--loose", type=float, default=1, help="factor on the bars of time, where other work goes on")
    parser.add_argument("--real-time", action="store_true", help="before all other work of the machine; takes root")
    options = parser.parse_args()
    if options.real_time:  # the servers inherit it
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    with tempfile.TemporaryDirectory() as folder:
        return 1 if report(options, *soak(options, Path(folder))) else 0


if __name__ == "__main__":
    sys.exit(main())

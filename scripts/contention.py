#!/usr/bin/env python3
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What other programs on the same cores cost: the network's time alone, and beside busy processes.

    scripts/contention.py build/cpu/bin/vla models/metaworld-tiny.gguf
    scripts/contention.py build/cpu/bin/vla --arch smolvla --size full --runs 5

Everything behind the program goes to `vla bench`. Rounds alone and beside 1 and 2 busy loops take turns, three times; a
row has the medians. On n cores beside k loops a program of n threads can have n / (n + k) of its quiet speed at best.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))
from busy_loops import busy_loops  # noqa: E402


def network_ms(command, n_busy):
    """Median milliseconds of the network's stages over the rounds of one process."""
    with busy_loops(n_busy):
        result = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(result.stdout.splitlines()[-1])["stages"]["network"]["p50_ms"]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("vla", help="the program")
    parser.add_argument("bench", nargs=argparse.REMAINDER, help="arguments of vla bench")
    args = parser.parse_args()
    cores = len(os.sched_getaffinity(0))
    times = {0: [], 1: [], 2: []}
    for _ in range(3):
        for n_busy in times:
            times[n_busy].append(network_ms([args.vla, "bench", *args.bench, "--json"], n_busy))
            print(f"beside {n_busy}: {times[n_busy][-1]:.1f} ms", file=sys.stderr)
    quiet = statistics.median(times[0])
    print(f"| busy processes on {cores} cores | network, ms | of the quiet time | ideal |\n| --- | ---: | ---: | ---: |")
    for n_busy, values in times.items():
        median = statistics.median(values)
        print(f"| {n_busy} | {median:.1f} | {median / quiet:.2f} | {(cores + n_busy) / cores:.2f} |")


if __name__ == "__main__":
    main()

#!/usr/bin/env python3
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What a client that behaves gets from `vla serve` while other peers attack it, as rows of a Markdown table.

scripts/serve_attacked.py                 the shipped policy, 20 seconds quiet and 20 under every attack at once
scripts/serve_attacked.py --attack half_sent --attack flood
scripts/serve_attacked.py --each         a row for each attack alone
scripts/serve_attacked.py --real-time    on a machine that does other work beside it

The attacks are in scripts/attacks/. They come from 127.0.0.2 (`own_address` from the robot's 127.0.0.1 and
`many_addresses` from 256 others), after all other work of the machine, since they are to attack the server and not the
cores that it shares with them here; with --real-time as other work, and server and robots before it. Fails where an
answer is lost or wrong, or a row misses its bar. docs/security.md says what is promised.
"""

import argparse
import itertools
import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
from attacks import ATTACKS
from attacks.robots import MAX_MESSAGE_MIB, Behaved, Target, slow_upload

ROOT = Path(__file__).resolve().parents[1]
HEALTH_MS, LATE_MS, ACT_RATIO = 20, 20, 2  # the bars
ROBOTS = ("act", "openpi", "gr00t", "lerobot")


def p(values, percent):
    return float(np.percentile(values, percent)) if values else float("nan")


def give_way(options):
    """To the server and to who behaves: they are before all other work of the machine, or this comes after it."""
    os.sched_setscheduler(0, os.SCHED_OTHER if options.real_time else os.SCHED_IDLE, os.sched_param(0))
    if not options.real_time:
        os.nice(19)


def cpu_seconds(process):
    """That it has used so far."""
    fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def measure(options, attacks):
    """Times of `Behaved` when quiet and under these attacks at once, and how the server stood it."""
    target = Target(options)
    attackers = []
    try:
        behaved = Behaved(target)
        behaved.watch(1)  # warm
        quiet = behaved.watch(options.seconds)
        before = target.memory_mib()
        names = [name for name in attacks if target.lerobot or name != "lerobot"]
        for name in names:
            where = [getattr(target, place) for place in Target.PLACES]
            command = [sys.executable, __file__, "--as", name, *where, *["--real-time"] * options.real_time]
            attackers.append(subprocess.Popen(command, stdout=subprocess.PIPE))
        [attacker.stdout.readline() for attacker in attackers]
        time.sleep(1)
        uploaded = []
        upload = threading.Thread(target=slow_upload, args=(target, options.seconds * 0.8, uploaded))
        upload.start()
        used = sum(map(cpu_seconds, attackers))
        attacked = behaved.watch(options.seconds)
        used = sum(map(cpu_seconds, attackers)) - used
        upload.join()
        ended = [name for name, a in zip(names, attackers) if a.poll() is not None]
        grown = target.memory_mib("VmHWM") - before
    finally:
        [a.kill() for a in attackers]
        [a.wait() for a in attackers]
        target.process.terminate()
    status = target.process.wait(20)
    return quiet, attacked, dict(grown_mib=grown, used_s=used, uploaded=bool(uploaded), ended=ended, status=status)


def rows_of(options, quiet, attacked, rest):
    """(what, measured when quiet, under attack, bar, whether it holds)"""
    loose = options.loose
    memory = (36 if "lerobot" in quiet else 24) * MAX_MESSAGE_MIB + 15 * 16 + 10  # docs/security.md
    rows = []
    for name, q in itertools.product([n for n in ROBOTS if n in quiet], (50, 95)):
        before, after = p(quiet[name], q), p(attacked[name], q)
        what = name if name == "act" else f"act by {name}"
        rows.append((f"{what} p{q}, ms", f"{before:.1f}", f"{after:.1f} ({after / before:.2f}x)",
                     f"{ACT_RATIO * loose:g}x", after <= ACT_RATIO * loose * before))  # fmt: skip
    for name, bar in (("health", HEALTH_MS), ("healthz", HEALTH_MS), ("late", LATE_MS)):
        worst = p(attacked[name], 95)
        what = "LATE after its deadline" if name == "late" else name
        rows.append((f"{what} p95 (largest), ms", f"{p(quiet[name], 95):.1f} ({max(quiet[name], default=0):.1f})",
                     f"{worst:.1f} ({max(attacked[name], default=0):.1f})", f"{bar * loose:g}",
                     worst <= bar * loose))  # fmt: skip
    rows += [
        ("memory beyond the policy, MiB", "", f"{rest['grown_mib']:.0f}", f"{memory}", rest["grown_mib"] <= memory),
        ("a slow upload is answered", "", str(rest["uploaded"]), "True", rest["uploaded"]),
        ("processor time of the attacks, s", "", f"{rest['used_s']:.1f}", "", True),
        ("attacks that gave up", "", ", ".join(rest["ended"]) or "none", "none", not rest["ended"]),
        ("exit status", "", str(rest["status"]), "0", rest["status"] == 0),
    ]
    return rows


def parse():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bundle", type=Path, default=ROOT / "models/metaworld-tiny.gguf")
    parser.add_argument("--vla", type=Path, default=Path(os.environ.get("VLA_BINARY", ROOT / "build/cpu/bin/vla")))
    parser.add_argument("--threads", type=int, default=1, help="of the engine; default: 1")
    parser.add_argument("--seconds", type=float, default=20, help="of each measurement; default: 20")
    parser.add_argument("--attack", action="append", choices=ATTACKS, help="default: all at once")
    parser.add_argument("--each", action="store_true", help="one after the other, a row for each")
    parser.add_argument("--loose", type=float, default=1, help="factor on the bars of time, where other work goes on")
    parser.add_argument("--real-time", action="store_true", help="server and robots before all other work; takes root")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--as", dest="role", nargs=6, help=argparse.SUPPRESS)  # attack, then Target's addresses
    return parser.parse_args()


def row_of(options, attack, quiet, attacked, rest):
    """p95 of the robots when quiet and under this attack; what misses its bar."""
    times = [f"{p(quiet[n], 95):.1f} → {p(attacked[n], 95):.1f}" if n in quiet else "" for n in ROBOTS]
    others = [f"{p(attacked[n], 95):.1f}" for n in ("health", "healthz", "late")]
    missed = [what for what, *_, holds in rows_of(options, quiet, attacked, rest) if not holds]
    cells = [f"`{attack}`", *times, *others, f"{rest['grown_mib']:.0f}", f"{rest['used_s']:.1f}"]
    cells.append(", ".join(missed) or "none")
    print(f"| {' | '.join(cells)} |", flush=True)
    return not missed


def each(options):
    """A table with a row for each attack."""
    print("| attack | act | openpi | GR00T | LeRobot | health | /healthz | LATE | MiB | its CPU, s | missed |\n|" + " --- |" * 11)
    attacks = options.attack or ATTACKS
    return all([row_of(options, attack, *measure(options, [attack])) for attack in attacks])


def at_once(options):
    quiet, attacked, rest = measure(options, options.attack or ATTACKS)
    rows = rows_of(options, quiet, attacked, rest)
    if options.json:
        print(json.dumps({"quiet": quiet, "attacked": attacked, **rest}))
    else:
        print("| | quiet | under attack | bar |\n| --- | --- | --- | --- |")
        for what, before, under, bar, holds in rows:
            print(f"| {what} | {before} | {under} | {bar}{'' if holds else ' **missed**'} |")
        counts = ", ".join(f"{len(attacked[name])} {name}" for name in attacked)
        print(f"\nUnder attack: {counts}.")
    return all(row[-1] for row in rows)


def main():
    options = parse()
    if options.role:
        attack, *addresses = options.role
        print("attacking", flush=True)
        give_way(options)  # what is imported before that is not part of the attack
        return ATTACKS[attack](argparse.Namespace(**dict(zip(Target.PLACES, addresses))))
    if options.real_time:  # the server inherits it
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    return 0 if (each if options.each else at_once)(options) else 1


if __name__ == "__main__":
    sys.exit(main())

#!/usr/bin/env python3
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What clients that behave get from `vla serve` while other peers attack it, and what that costs the server, as a Markdown table.

scripts/serve_attacked.py                 the shipped policy: a row for each front end, 20 seconds quiet and 20 under all its attacks
scripts/serve_attacked.py --each          a row for each attack alone
scripts/serve_attacked.py --attack half_sent --attack flood
scripts/serve_attacked.py --check         fails where a row misses a bar
scripts/serve_attacked.py --real-time     on a machine that does other work beside it

A row has a server of its own, with a robot of each protocol. Acts that are lost; p99 in milliseconds, quiet and under attack; memory of the
server and its processes before, at the peak, and --settle seconds after the attack; seconds from SIGTERM to the end while it is attacked again.

The attacks are in scripts/attacks/. They come from 127.0.0.2 (`own_address` from the robots' 127.0.0.1 and
`many_addresses` from 256 others), after all other work of the machine, since they are to attack the server and not the
cores that it shares with them here; with --real-time before all other work, and server and robots before them. An answer that is
wrong ends the script. docs/security.md says what is promised.
"""

import argparse
import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
from attacks import ATTACKS, ATTACKS_OF, DOOR_OF
from attacks.robots import MAX_MESSAGE_MIB, Behaved, Peak, Target, slow_upload

ROOT = Path(__file__).resolve().parents[1]
ROBOTS = ("act", "openpi", "gr00t", "lerobot")
PROBES = ("health", "healthz", "page", "order")
# The bars.
ACT_RATIO, HEALTH_MS, LATE_MS, END_S, BACK_S, KEPT = 2, 50, 20, 3, 2, 1.1
KEPT_AT_FIRST = 1.25  # of the memory before, within the first minute after an attack
PAGE_MIB = 96


def p(values, percent):
    return float(np.percentile(values, percent)) if values else float("nan")


def give_way(options):
    """To the server and to who behaves."""
    os.sched_setscheduler(0, os.SCHED_OTHER if options.real_time else os.SCHED_IDLE, os.sched_param(0))
    os.nice(-20 if options.real_time else 19)


def cpu_seconds(pid):
    """That it has used so far."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:  # it has ended
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


class Attack:
    """A process for each attack, until `stop`."""

    def __init__(self, options, target, names):
        where = [getattr(target, place) for place in Target.PLACES]
        command = [sys.executable, __file__, "--as", ",".join(names), *where, *["--real-time"] * options.real_time]
        self._first = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True)
        self._pids = self._first.stdout.readline().split()

    def cpu_seconds(self):
        return sum(cpu_seconds(pid) for pid in self._pids)

    def stop(self):
        """Names of the attacks that had ended by themselves."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._first.pid, signal.SIGKILL)
        self._first.wait()
        with self._first.stdout as ended:
            return ended.read().split()


def attack(options):
    """In the process of `Attack`: one for each, which has to import nothing, since what is imported is not part of the attack."""
    names, *addresses = options.role
    target, pids = argparse.Namespace(**dict(zip(Target.PLACES, addresses))), {}
    give_way(options)
    for name in names.split(","):
        pid = os.fork()
        if not pid:
            ATTACKS[name](target)
            os._exit(0)
        pids[pid] = name
    print(*pids, flush=True)
    while pids:
        print(pids.pop(os.wait()[0]), flush=True)


def measure(options, names):
    """Times of `Behaved` when quiet and under these attacks at once, and how the server stood it."""
    target = Target(options, {DOOR_OF[name] for name in names})
    attack, is_over = None, False
    try:
        behaved = Behaved(target, options.patience)
        behaved.watch(1)  # warm
        quiet = behaved.watch(options.seconds)
        before, peak, processes = target.memory_mib(), Peak(target), target.processes()
        attack = Attack(options, target, names)
        time.sleep(1)
        uploaded = []
        upload = threading.Thread(target=slow_upload, args=(target, options.seconds * 0.8, uploaded))
        upload.start()
        used = attack.cpu_seconds()
        attacked = behaved.watch(options.seconds)
        rest = dict(lost=behaved.lost, back=behaved.back, used_s=attack.cpu_seconds() - used)
        upload.join()
        rest["gave_up"], attack = attack.stop(), None
        rest.update(before=before, peak=peak.stop(), uploaded=bool(uploaded))
        time.sleep(options.settle)
        rest["after"], rest["replaced"] = target.memory_mib(), target.processes() != processes
        attack = Attack(options, target, names)
        time.sleep(1)
        rest["end_s"], rest["status"] = target.end()
        is_over = True
    finally:
        if attack:
            attack.stop()
        if not is_over:
            target.process.kill()
            target.process.wait()
    return quiet, attacked, rest


def missed(options, names, quiet, attacked, rest):
    """The bars that a row does not reach, each with what was measured."""
    loose, is_process = options.loose, any(DOOR_OF[name] == "process" for name in names)
    page = ("page" in quiet) * PAGE_MIB  # which robots fill, and nobody empties
    memory = (28 + 16) * MAX_MESSAGE_MIB + 128 + 15 * 16 + 10 + page  # of server and process, docs/security.md
    found = []

    def bar(what, value, most, unit=""):
        if not value <= most:
            found.append(f"{what} {value:.3g}{unit} > {most:.3g}{unit}")

    for name in (name for name in (*ROBOTS, *PROBES) if name in quiet):
        own = is_process and name == "lerobot"  # whose acts under way end with the process
        bar(f"{name}: lost", rest["lost"][name], float("inf") if own else 0)
        bar(f"{name}: back after", rest["back"][name], BACK_S * loose, " s")
        for q in (50, 95) if name in ROBOTS and not own else ():
            paused_ms = HEALTH_MS * loose if loose > 1 and q > 50 else 0  # one pause of the machine is a twentieth of a short measurement
            bar(f"{name} p{q}", p(attacked[name], q), max(ACT_RATIO * loose * p(quiet[name], q), paused_ms), " ms")
    for name, q, most in (("health", 99, HEALTH_MS), ("healthz", 99, HEALTH_MS), ("late", 95, LATE_MS)):
        if attacked[name] or name != "late":
            bar(f"{name} p{q}", p(attacked[name], q), most * loose, " ms")
    if rest["replaced"] != (is_process and names != ["door_without_memory"]):
        found.append("a process of --lerobot ended" if rest["replaced"] else "no process of --lerobot ended")
    bar("memory at the peak", rest["peak"] - rest["before"], memory, " MiB")
    kept = KEPT if options.settle >= 60 else KEPT_AT_FIRST
    bar("memory after", rest["after"], kept * rest["before"] + page, " MiB")
    bar("end", rest["end_s"], END_S * loose, " s")
    bar("exit status", abs(rest["status"]), 0)
    if not rest["uploaded"]:
        found.append("a slow upload was not answered")
    found += [f"{name} gave up" for name in rest["gave_up"]]
    return found


def row_of(options, what, names):
    """Prints a row; whether it reaches its bars."""
    quiet, attacked, rest = measure(options, names)
    times = [f"{p(quiet[n], 99):.1f} → {p(attacked[n], 99):.1f}" if n in quiet else "" for n in (*ROBOTS, *PROBES)]
    lost = ", ".join(f"{n} {name}" for name, n in rest["lost"].items() if n) or "0"
    memory = f"{rest['before']:.0f}, {rest['peak']:.0f}, {rest['after']:.0f}"
    problems = missed(options, names, quiet, attacked, rest)
    cells = [what, lost, *times, f"{p(attacked['late'], 95):.1f}", memory, f"{rest['end_s']:.1f}", f"{rest['used_s']:.1f}", "; ".join(problems) or "none"]
    print(f"| {' | '.join(cells)} |", flush=True)
    return not problems


def parse():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bundle", type=Path, default=ROOT / "models/metaworld-tiny.gguf")
    parser.add_argument("--vla", type=Path, default=Path(os.environ.get("VLA_BINARY", ROOT / "build/cpu/bin/vla")))
    parser.add_argument("--threads", type=int, default=1, help="of the engine; default: 1")
    parser.add_argument("--seconds", type=float, default=20, help="of each measurement; default: 20")
    parser.add_argument("--attack", action="append", choices=ATTACKS, help="these at once, in a row")
    parser.add_argument("--door", action="append", type=lambda text: text.split(","), help=f"a row of all attacks on it, or on several with commas between; default: one for each of {', '.join(ATTACKS_OF)}")
    parser.add_argument("--each", action="store_true", help="a row for each attack alone")
    parser.add_argument("--settle", type=float, default=60, help="seconds after an attack, in which memory is to be given back; default: 60")
    parser.add_argument("--patience", type=float, default=5, help="seconds, after which an act is lost; default: 5")
    parser.add_argument("--check", action="store_true", help="exit code 1 where a bar is missed")
    parser.add_argument("--loose", type=float, default=1, help="factor on the bars of time, where other work goes on")
    parser.add_argument("--real-time", action="store_true", help="server and robots, then the attacks, before all other work; takes root")
    parser.add_argument("--as", dest="role", nargs=1 + len(Target.PLACES), help=argparse.SUPPRESS)  # attacks, then Target's addresses
    return parser.parse_args()


def rows_of(options):
    """What each row is called, and its attacks."""
    if options.attack:
        return [(" ".join(options.attack), options.attack)]
    rows = []
    for doors in options.door or [[door] for door in ATTACKS_OF]:
        names = [attack.__name__ for door in doors for attack in ATTACKS_OF[door]]
        is_alone = options.each or doors == ["process"]  # its process ends in one way at a time
        rows += [(f"{DOOR_OF[name]}: {name}", [name]) for name in names] if is_alone else [(", ".join(doors), names)]
    return rows


def main():
    options = parse()
    if options.role:
        return attack(options)
    if options.real_time:  # the server inherits it
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    heads = ["attack", "lost", *(f"{name} p99" for name in (*ROBOTS, *PROBES)), "LATE p95", "MiB: before, peak, after", "end, s", "its CPU, s", "missed"]
    print(f"| {' | '.join(heads)} |\n|{' --- |' * len(heads)}")
    results = [row_of(options, what, names) for what, names in rows_of(options)]
    return 1 if options.check and not all(results) else 0


if __name__ == "__main__":
    sys.exit(main())

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""How late answers, the replan interval and blending change how well a robot tracks: a simulation of vla_cpp.control.

    python latency_sweep.py                                  # a table
    python latency_sweep.py --svg latency_sweep.svg          # and a picture

The toy world: a hand in a plane follows a target on a wandering path. Commands are positions; the hand closes a fifth of the distance
in each hundredth of a second. The toy policy sees where the target is and how fast it goes, and answers with a straight line from
there: right for a moment, wrong for long. Each chunk is also off by an error of its own, as those of a policy that samples are, so
that chunks disagree. Time is simulated, so that a run is the same on every machine; the loop is the one that drives a robot.

Needs numpy and vla_cpp.
"""

import argparse
import sys
from pathlib import Path
from typing import Dict, List, NamedTuple, Tuple

import numpy as np

from vla_cpp import BundleInfo, Chunk, Spec
from vla_cpp.control import ChunkLoop

RATE_HZ = 20.0
HORIZON = 16
SECONDS = 30.0
PLANT_DT = 0.01  # seconds
APPROACH = 0.2  # share of the distance to the command that the hand closes in one PLANT_DT
CHUNK_ERROR = 0.02  # metres: standard deviation of what a chunk is off by, as a whole
LATENCIES_MS = (0, 50, 150, 400)  # median; log-normal around it
SPREAD = 0.25  # deviation of the logarithm of a latency
INTERVALS = (1, 2, 4, 6, 8, 10, 12, 14, 16)
N_SEED = 4
BLENDS = ("replace", "linear", "ensemble")
SPEC = Spec(
    views=(), min_views=0, states=(), action_names=("x", "y"), action_units=("m", "m"), horizon=HORIZON, d_action=2,
    d_noise=2, noise_rows=HORIZON, noise="normal", rate_hz=RATE_HZ, bundle=BundleInfo("toy", "toy", "", ""), precision="",
    kernels="", device="",
)  # fmt: skip


def target(t):
    """Where the target is at time t (seconds): metres, (2,)."""
    return np.array(
        [0.20 * np.sin(1.3 * t) + 0.08 * np.sin(3.1 * t), 0.20 * np.cos(0.9 * t) + 0.08 * np.sin(2.3 * t + 1)]
    )


class World:
    """Simulated time, and a hand that goes where it was last told."""

    def __init__(self):
        self.now, self.n_done = 0.0, 0
        self.hand = target(0.0)
        self.command = self.hand
        self.errors: List[float] = []

    def sleep(self, seconds):
        self.now += seconds
        while (self.n_done + 1) * PLANT_DT <= self.now + 1e-9:
            self.n_done += 1
            self.hand = self.hand + APPROACH * (self.command - self.hand)
            self.errors.append(float(np.linalg.norm(self.hand - target(self.n_done * PLANT_DT))))


class Pending:
    def __init__(self, world, due, chunk):
        self.world, self.due, self.chunk = world, due, chunk

    def done(self):
        return self.world.now >= self.due - 1e-9

    def result(self):
        self.world.sleep(max(0.0, self.due - self.world.now))
        return self.chunk


class ToyPolicy:
    """Like vla_cpp.Client: `spec` and `submit`."""

    spec = SPEC

    def __init__(self, world, latency_ms, seed):
        self.world, self.latency_ms, self.random = world, latency_ms, np.random.default_rng(seed)

    def submit(self, *, state):
        position, velocity = state
        ahead = (1 + np.arange(HORIZON))[:, None] / RATE_HZ
        rows = position + velocity * ahead + self.random.normal(0, CHUNK_ERROR, 2)
        latency = self.latency_ms / 1000 * np.exp(self.random.normal(0, SPREAD))
        return Pending(
            self.world, self.world.now + latency, Chunk(rows.astype(np.float32), ("x", "y"), RATE_HZ, SPEC.bundle)
        )


class Result(NamedTuple):
    error_mm: float  # root mean square distance of hand and target
    jump_mm: float  # 99th percentile of the change from one command to the next
    held: float  # share of the control periods


def simulate(latency_ms, interval, mode, blend, seed):
    world = World()
    policy = ToyPolicy(world, latency_ms, seed)
    fade = {"fade_steps": max(1, interval // 2)} if blend == "linear" else {}
    loop = ChunkLoop(
        policy, rate_hz=RATE_HZ, replan_every=interval, mode=mode, blend=blend, on_late="hold", on_note="raise",
        clock=lambda: world.now, sleep=world.sleep, **fade,
    )  # fmt: skip

    def look():
        return {"state": (target(world.now), (target(world.now) - target(world.now - 0.01)) / 0.01)}

    loop.begin(look())
    world.errors.clear()
    end, commands = world.now + SECONDS, []
    while world.now < end:
        action = loop.step(look)
        if action.values is not None:
            world.command = action.values.astype(float)
            commands.append(world.command)
        loop.pace()
    jumps = np.linalg.norm(np.diff(commands, axis=0), axis=1)
    n_period = loop.stats["actions"] + loop.stats["held"] + loop.stats["missed"]
    return Result(
        1000 * float(np.sqrt(np.mean(np.square(world.errors)))),
        1000 * float(np.percentile(jumps, 99)),
        (loop.stats["held"] + loop.stats["missed"]) / n_period,
    )


Sweep = Dict[Tuple[int, str, str], List[Result]]


def sweep(latencies, intervals, n_seed) -> Sweep:
    """{(latency, mode, blend): one mean result per interval}."""
    results: Sweep = {}
    for latency in latencies:
        for mode in ("sync", "async"):
            for blend in BLENDS:
                runs = [[simulate(latency, s, mode, blend, seed) for seed in range(n_seed)] for s in intervals]
                results[latency, mode, blend] = [Result(*np.mean(r, axis=0)) for r in runs]
                print(".", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    return results


def print_table(results: Sweep, intervals) -> None:
    print(
        "tracking error in mm (99th percentile of the change from one command to the next in mm; periods without an action in %)"
    )
    print(f"{'latency':>8} {'mode':>6} {'blend':>9}  " + "".join(f"{'S=' + str(s):>16}" for s in intervals))
    for (latency, mode, blend), row in results.items():
        cells = "".join(f"{f'{r.error_mm:.0f} ({r.jump_mm:.0f}; {100 * r.held:.0f})':>16}" for r in row)
        print(f"{latency:>5} ms {mode:>6} {blend:>9}  {cells}")


# --- the picture ------------------------------------------------------------------------------------------------------------------

COLOURS = {"replace": "#c2410c", "linear": "#0369a1", "ensemble": "#15803d"}
ROWS = (("error_mm", "tracking error (mm)"), ("jump_mm", "change of command, p99 (mm)"))
PANEL_W, PANEL_H, GAP_X, GAP_Y, LEFT, TOP = 200, 150, 26, 46, 64, 74


def draw(results: Sweep, intervals) -> str:
    """An SVG: a column for each latency, a row for each measure, a line for each mode and blend."""
    latencies = sorted({key[0] for key in results})
    width = LEFT + len(latencies) * (PANEL_W + GAP_X)
    height = TOP + len(ROWS) * (PANEL_H + GAP_Y) + 14
    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" font-family="sans-serif" font-size="11">',
        f'<rect width="{width}" height="{height}" fill="white"/>',
        *legend(),
    ]
    for i, (field, title) in enumerate(ROWS):
        top = TOP + i * (PANEL_H + GAP_Y)
        limit = ceiling(max(getattr(r, field) for row in results.values() for r in row))
        middle = top + PANEL_H / 2
        out.append(f'<text transform="rotate(-90 14 {middle})" x="14" y="{middle}" text-anchor="middle">{title}</text>')
        for j, latency in enumerate(latencies):
            left = LEFT + j * (PANEL_W + GAP_X)
            out += axes(left, top, limit, intervals, j == 0, i == len(ROWS) - 1)
            if i == 0:
                title = f"latency {latency} ms" if latency else "no latency"
                out.append(
                    f'<text x="{left + PANEL_W / 2}" y="{top - 8}" text-anchor="middle" font-weight="bold">{title}</text>'
                )
            for (at, mode, blend), row in results.items():
                if at == latency:
                    out.append(line(left, top, limit, intervals, [getattr(r, field) for r in row], mode, blend))
    return "\n".join([*out, "</svg>"]) + "\n"


def place(left, top, limit, intervals, s, value):
    span = intervals[-1] - intervals[0]
    return left + 6 + (PANEL_W - 12) * (s - intervals[0]) / span, top + PANEL_H * (1 - value / limit)


def ceiling(value):
    """The next round number above."""
    step = 10.0 ** np.floor(np.log10(value))
    return step * next(k for k in (1, 1.5, 2, 3, 4, 5, 6, 8, 10) if k * step >= value)


def axes(left, top, limit, intervals, has_scale, has_title):
    out = [f'<rect x="{left}" y="{top}" width="{PANEL_W}" height="{PANEL_H}" fill="none" stroke="#999"/>']
    for k in range(5):
        y = top + PANEL_H * (1 - k / 4)
        out.append(f'<line x1="{left}" x2="{left + PANEL_W}" y1="{y}" y2="{y}" stroke="#e5e5e5"/>')
        if has_scale:
            out.append(f'<text x="{left - 6}" y="{y + 4}" text-anchor="end">{limit * k / 4:g}</text>')
    for s in intervals[::2]:
        x, _ = place(left, top, limit, intervals, s, 0)
        out.append(f'<text x="{x}" y="{top + PANEL_H + 14}" text-anchor="middle">{s}</text>')
    if has_title:
        middle = left + PANEL_W / 2
        out.append(f'<text x="{middle}" y="{top + PANEL_H + 30}" text-anchor="middle">replan interval S (steps)</text>')
    return out


def line(left, top, limit, intervals, values, mode, blend):
    points = " ".join(
        "{:.1f},{:.1f}".format(*place(left, top, limit, intervals, s, v)) for s, v in zip(intervals, values)
    )
    dash = ' stroke-dasharray="5 4"' if mode == "sync" else ""
    return f'<polyline points="{points}" fill="none" stroke="{COLOURS[blend]}" stroke-width="1.8"{dash}/>'


def legend():
    out, x = (
        [
            f'<text x="{LEFT}" y="18" font-size="13" font-weight="bold">Tracking with chunks of {HORIZON} rows at {RATE_HZ:g} Hz</text>'
        ],
        LEFT,
    )
    for label, colour, dash in [
        *((b, c, "") for b, c in COLOURS.items()),
        ("async", "#444", ""),
        ("sync", "#444", "5 4"),
    ]:
        out.append(
            f'<line x1="{x}" x2="{x + 26}" y1="36" y2="36" stroke="{colour}" stroke-width="2" stroke-dasharray="{dash}"/>'
        )
        out.append(f'<text x="{x + 32}" y="40">{label}</text>')
        x += 110
    return out


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--svg", type=Path, help="write a picture")
    parser.add_argument("--quick", action="store_true", help="few points, for a test")
    args = parser.parse_args()
    latencies, intervals, n_seed = ((0, 150), (2, 8, 16), 1) if args.quick else (LATENCIES_MS, INTERVALS, N_SEED)
    results = sweep(latencies, intervals, n_seed)
    print_table(results, intervals)
    if args.svg:
        args.svg.write_text(draw(results, intervals), encoding="utf-8")


if __name__ == "__main__":
    main()

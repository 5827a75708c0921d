# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures of results. Needs matplotlib, which the extra `eval` brings."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Dict, List, Sequence

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

BLUE, ORANGE, GREY = "#1362c4", "#e07b1f", "#7a828e"


def _finish(figure: Any, path: Path) -> None:
    for axes in figure.axes:
        axes.spines["top"].set_visible(False)
        axes.grid(axis="y", color="#e2e5ea", linewidth=0.8)
        axes.set_axisbelow(True)
    figure.tight_layout()
    figure.savefig(str(path), dpi=150)
    plt.close(figure)


def success_bars(tables: Dict[str, Dict[str, Dict[str, Any]]], title: str, path: Path) -> None:
    """Success by task with its 95 % intervals, one group of bars per policy."""
    names = list(next(iter(tables.values())))
    figure, axes = plt.subplots(figsize=(1.6 + 1.5 * len(names), 3.6))
    width = 0.8 / len(tables)
    for i, (label, table) in enumerate(tables.items()):
        at = [k + (i - (len(tables) - 1) / 2) * width for k in range(len(names))]
        rates = [100 * (table[name]["rate"] or 0) for name in names]
        below = [rate - 100 * table[name]["wilson95"][0] for rate, name in zip(rates, names)]
        above = [100 * table[name]["wilson95"][1] - rate for rate, name in zip(rates, names)]
        axes.bar(at, rates, 0.9 * width, color=(BLUE, ORANGE)[i % 2], label=label)
        axes.errorbar(at, rates, yerr=[below, above], fmt="none", ecolor="#20242c", capsize=3, linewidth=1)
        for x, name, rate, up in zip(at, names, rates, above):
            axes.text(x, rate + up + 1.5, f"{table[name]['solved']}/{table[name]['episodes']}", ha="center", fontsize=8)
    axes.set_xticks(range(len(names)), names, fontsize=9)
    axes.set_ylim(0, 112)
    axes.set_ylabel("solved, %")
    axes.set_title(title, fontsize=10, loc="left")
    if len(tables) > 1:
        axes.legend(frameon=False, fontsize=8, loc="lower right")
    _finish(figure, path)


def replan_curves(rows: Sequence[Dict[str, Any]], rate_hz: float, title: str, path: Path) -> None:
    """Success, inference per step and control rate against the replan interval S."""
    intervals = [row["replan_every"] for row in rows]
    figure, panels = plt.subplots(1, 3, figsize=(11, 3.4))
    rates = [100 * row["success"]["rate"] for row in rows]
    bounds = [[100 * (row["success"]["rate"] - row["success"]["wilson95"][0]) for row in rows],
              [100 * (row["success"]["wilson95"][1] - row["success"]["rate"]) for row in rows]]  # fmt: skip
    panels[0].errorbar(intervals, rates, yerr=bounds, color=BLUE, marker="o", capsize=3)
    panels[0].set_ylim(0, 105)
    panels[0].set_ylabel("solved, % (95 % interval)")
    panels[1].plot(intervals, [row["latency"]["amortised_ms"] for row in rows], color=BLUE, marker="o", label="inference per executed step")
    panels[1].plot(intervals, [row["latency"]["round_trip_ms"]["p50"] for row in rows], color=GREY, marker="s", label="one replan, median")
    panels[1].set_yscale("log")
    panels[1].set_ylabel("ms")
    panels[1].legend(frameon=False, fontsize=8)
    panels[2].plot(intervals, [row["latency"]["control_rate_hz"] for row in rows], color=BLUE, marker="o")
    panels[2].axhline(rate_hz, color=ORANGE, linewidth=1.2)
    panels[2].text(intervals[0], rate_hz * 1.05, f"the robot's {rate_hz:g} Hz", color=ORANGE, fontsize=8)
    panels[2].set_yscale("log")
    panels[2].set_ylabel("steps per second that inference allows")
    for panel in panels:
        panel.set_xscale("log", base=2)
        panel.set_xticks(intervals, [str(s) for s in intervals])
        panel.set_xlabel("replan interval S, steps")
    panels[0].set_title(title, fontsize=10, loc="left")
    _finish(figure, path)


def difference_curves(table: List[Dict[str, Any]], title: str, path: Path) -> None:
    """Distance of two policies' chunks at the same observation, along the episode."""
    looks = [row["look"] for row in table]
    figure, axes = plt.subplots(figsize=(6, 3.4))
    for key, style in (("max", "-"), ("p95", "--"), ("p50", ":")):
        axes.plot(looks, [max(row[key], 1e-9) for row in table], style, color=BLUE, label={"max": "largest", "p95": "95 %", "p50": "median"}[key])
    axes.set_yscale("log")
    axes.set_xlabel("look at the scene")
    axes.set_ylabel("largest difference in a chunk, action units")
    axes.set_title(title, fontsize=10, loc="left")
    axes.legend(frameon=False, fontsize=8)
    _finish(figure, path)

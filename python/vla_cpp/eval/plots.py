# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Images of results. Needs matplotlib, which the extra `eval` brings."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Dict, List, Sequence

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullFormatter, NullLocator  # noqa: E402

from ..output import whole_file  # noqa: E402

BLUE, ORANGE, GREY, INK = "#1362c4", "#e07b1f", "#7a828e", "#20242c"


def _finish(figure: Any, title: str, path: Path) -> None:
    """Titles belong to the figure: a panel is too narrow for the name of a policy."""
    for axes in figure.axes:
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="y", color="#e2e5ea", linewidth=0.8)
        axes.set_axisbelow(True)
    figure.suptitle(title, fontsize=10.5, x=0.01, ha="left")
    with whole_file(path) as file:
        figure.savefig(file, format=path.suffix[1:], dpi=150)
    plt.close(figure)


def _figure(width: float, height: float, panels: int = 1) -> Any:
    figure, axes = plt.subplots(1, panels, figsize=(width, height), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.08, h_pad=0.08)
    return figure, axes


def plain_log(axes: Any, values: Sequence[float]) -> None:
    """A logarithmic y axis around the values that is labelled in plain numbers: 1, 2, 5, 10, ..."""
    low, high = 0.85 * min(values), 1.18 * max(values)
    steps = [m * 10.0**e for e in range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1) for m in (1, 2, 5)]
    if sum(low <= step <= high for step in steps) < 2:  # too narrow for two labels: from label to label
        low, high = max(step for step in steps if step <= low), min(step for step in steps if step >= high)
    axes.set_yscale("log")
    axes.set_ylim(low, high)
    axes.yaxis.set_major_locator(FixedLocator([step for step in steps if low <= step <= high]))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_locator(NullLocator())


def success_bars(tables: Dict[str, Dict[str, Dict[str, Any]]], title: str, path: Path) -> None:
    """Success by task, or by suite where there are suites, with 95 % intervals; one group of bars per policy."""
    table = next(iter(tables.values()))
    suites = {name.rpartition("/")[0] for name in table} - {""}
    names = [name for name in table if not suites or name in suites or name == "all"]
    figure, axes = _figure(1.6 + 1.5 * len(names), 3.9)
    width = 0.8 / len(tables)
    for i, (label, table) in enumerate(tables.items()):
        at = [k + (i - (len(tables) - 1) / 2) * width for k in range(len(names))]
        rates = [100 * (table[name]["rate"] or 0) for name in names]
        below = [rate - 100 * table[name]["wilson95"][0] for rate, name in zip(rates, names)]
        above = [100 * table[name]["wilson95"][1] - rate for rate, name in zip(rates, names)]
        axes.bar(at, rates, 0.9 * width, color=(BLUE, ORANGE)[i % 2], label=label)
        axes.errorbar(at, rates, yerr=[below, above], fmt="none", ecolor=INK, capsize=3, linewidth=1)
        for x, name, rate, up in zip(at, names, rates, above):
            axes.text(x, rate + up + 1.5, f"{table[name]['solved']}/{table[name]['episodes']}", ha="center", fontsize=8)
    axes.set_xticks(range(len(names)), names, fontsize=9)
    axes.set_ylim(0, 112)
    axes.set_yticks(range(0, 101, 20))
    axes.set_ylabel("solved, %")
    # Below the bars: on them it hides what it explains.
    figure.legend(frameon=False, fontsize=9, loc="outside lower left", ncols=len(tables))
    _finish(figure, title, path)


def replan_curves(rows: Sequence[Dict[str, Any]], rate_hz: float, title: str, path: Path) -> None:
    """Success, inference per step and control rate against the replan interval S."""
    intervals = [row["replan_every"] for row in rows]
    figure, (success, time, rate) = _figure(10.5, 3.6, 3)
    rates = [100 * row["success"]["rate"] for row in rows]
    bounds = [[100 * (row["success"]["rate"] - row["success"]["wilson95"][0]) for row in rows],
              [100 * (row["success"]["wilson95"][1] - row["success"]["rate"]) for row in rows]]  # fmt: skip
    success.errorbar(intervals, rates, yerr=bounds, color=BLUE, marker="o", capsize=3)
    success.set_ylim(0, 105)
    success.set_title("solved, %, with 95 % intervals", fontsize=9.5, loc="left")

    per_step = [row["latency"]["amortised_ms"] for row in rows]
    per_look = [row["latency"]["round_trip_ms"]["p50"] for row in rows]
    time.plot(intervals, per_look, color=GREY, marker="s", label="a replan, median")
    time.plot(intervals, per_step, color=BLUE, marker="o", label="per executed step")
    plain_log(time, per_step + per_look)
    time.set_title("inference, ms", fontsize=9.5, loc="left")
    time.legend(frameon=False, fontsize=8.5, loc="lower left")

    allowed = [row["latency"]["control_rate_hz"] for row in rows]
    rate.plot(intervals, allowed, color=BLUE, marker="o")
    rate.axhline(rate_hz, color=ORANGE, linewidth=1.2)
    rate.annotate(f"the robot's {rate_hz:g} Hz", (intervals[-1], rate_hz), (0, -11), textcoords="offset points", color=ORANGE, fontsize=8.5, ha="right")
    plain_log(rate, [*allowed, rate_hz])
    rate.set_title("steps per second that inference allows", fontsize=9.5, loc="left")
    for panel in (success, time, rate):
        panel.set_xscale("log", base=2)
        panel.set_xticks(intervals, [str(s) for s in intervals])
        panel.xaxis.set_minor_formatter(NullFormatter())
        panel.set_xlabel("replan interval S, steps")
    _finish(figure, title, path)


def difference_curves(table: List[Dict[str, Any]], title: str, path: Path) -> None:
    """Distance of two policies' chunks at the same observation, along the episode."""
    looks = [row["look"] for row in table]
    figure, axes = _figure(6.4, 3.7)
    for key, style, label in (("max", "-", "largest of all episodes"), ("p95", "--", "95 % of the episodes below"), ("p50", ":", "median")):
        axes.plot(looks, [max(row[key], 1e-9) for row in table], style, color=BLUE, label=label)
    axes.set_yscale("log")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True, nbins=10, min_n_ticks=1))
    axes.set_xlabel("look of the episode")
    axes.set_ylabel("largest difference in a chunk")
    axes.set_ylim(top=3 * max(max(row["max"], 1e-9) for row in table))
    axes.legend(frameon=False, fontsize=8.5, loc="upper right")
    _finish(figure, title, path)

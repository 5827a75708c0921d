# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""From episodes to tables: success with intervals, latency, the paired comparison."""

from __future__ import annotations

from typing import Any, Dict, List, Sequence

from .episode import Outcome
from .smoothness import mean_of
from .statistics import paired, quantile, wilson


def success(rows: Sequence[Outcome]) -> Dict[str, Any]:
    """Of these episodes: how many were solved, with the 95 % interval, and the steps that the solved ones took."""
    k, n = sum(row.solved for row in rows), len(rows)
    low, high = wilson(k, n)
    steps = [row.steps for row in rows if row.solved]
    return {"solved": k, "episodes": n, "rate": k / n if n else None, "wilson95": [low, high], "median_steps": quantile(steps, 0.5) if steps else None}


def by_task(rows: Sequence[Outcome]) -> Dict[str, Dict[str, Any]]:
    """`success` of each task in the order of its first episode, of each suite after its tasks, and of `all`."""
    table: Dict[str, Dict[str, Any]] = {}
    for suite in dict.fromkeys(suite_of(row.task) for row in rows):
        own = [row for row in rows if suite_of(row.task) == suite]
        table.update({task: success([row for row in own if row.task == task]) for task in dict.fromkeys(row.task for row in own)})
        if suite:
            table[suite] = success(own)
    return {**table, "all": success(rows)}


def suite_of(task: str) -> str:
    """`libero_goal` of `libero_goal/3`; empty for a task that is in no suite."""
    return task.rpartition("/")[0]


def latency(rows: Sequence[Outcome], rate_hz: float) -> Dict[str, Any]:
    """Milliseconds of a replan: round_trip as the robot sees it, engine as the policy reports it.

    amortised_ms  inference per executed step. control_rate_hz: steps per second that inference alone would allow, and keeps_up
                  whether that is what the robot needs.
    """
    trips = [ms for row in rows for ms in row.round_trip_ms]
    engine = [ms for row in rows for ms in row.engine_ms]
    steps = sum(row.steps for row in rows)
    amortised = sum(trips) / steps if steps else None
    return {
        "replans": len(trips),
        "round_trip_ms": {"p50": quantile(trips, 0.5), "p95": quantile(trips, 0.95)},
        "engine_ms": {"p50": quantile(engine, 0.5), "p95": quantile(engine, 0.95)},
        "amortised_ms": amortised,
        "control_rate_hz": 1e3 / amortised if amortised else None,
        "keeps_up": bool(amortised and 1e3 / amortised >= rate_hz),
    }


def pairs(rows: Sequence[Outcome]) -> Dict[str, Any]:
    """Drivers a and b on equal seeds: who solved what, McNemar's exact p, equal lengths, and every discordant episode."""
    of: Dict[str, Dict[Any, Outcome]] = {"a": {}, "b": {}}
    for row in rows:
        of[row.driver][(row.task, row.seed, row.sentence)] = row
    keys = [key for key in of["a"] if key in of["b"]]
    table = paired((of["a"][key].solved, of["b"][key].solved) for key in keys)
    discordant = [
        {"task": task, "seed": seed, "sentence": text, "a": of["a"][(task, seed, text)].solved, "b": of["b"][(task, seed, text)].solved,
         "a_steps": of["a"][(task, seed, text)].steps, "b_steps": of["b"][(task, seed, text)].steps,
         "difference": of["a"][(task, seed, text)].difference}
        for task, seed, text in keys
        if of["a"][(task, seed, text)].solved != of["b"][(task, seed, text)].solved
    ]  # fmt: skip
    return {
        "episodes": table.episodes, "both": table.both, "only_a": table.only_a, "only_b": table.only_b, "neither": table.neither,
        "mcnemar_p": table.p_value, "same_length": sum(of["a"][key].steps == of["b"][key].steps for key in keys),
        "discordant": discordant,
    }  # fmt: skip


def differences(rows: Sequence[Outcome]) -> List[Dict[str, Any]]:
    """Largest difference of the chunks at the same observation, by the look's place in its episode: quantiles over episodes."""
    table = []
    for look in range(max((len(row.difference) for row in rows), default=0)):
        values = [row.difference[look] for row in rows if len(row.difference) > look]
        table.append({"look": look + 1, "chunks": len(values), "p50": quantile(values, 0.5), "p95": quantile(values, 0.95), "max": max(values)})
    return table


def summary(rows: Sequence[Outcome], head: Dict[str, Any]) -> Dict[str, Any]:
    """Everything above that these episodes allow, as one JSON object."""
    of = {driver: [row for row in rows if row.driver == driver] for driver in ("a", "b")}
    out: Dict[str, Any] = {"run": head}
    for driver, suffix in (("a", ""), ("b", "_b")):
        own, swapped = ([row for row in of[driver] if row.swapped == which] for which in (False, True))
        out.update({key + suffix: by_task(part) for key, part in (("success", own), ("swapped", swapped)) if part})
    out["latency"] = latency(of["a"], head["rate_hz"])
    out["clipped_share"] = sum(row.clipped for row in of["a"]) / max(1, sum(row.steps for row in of["a"]))
    for driver, suffix in (("a", ""), ("b", "_b")):
        measured = [row.smoothness for row in of[driver] if row.smoothness]
        if measured:
            out["smoothness" + suffix] = mean_of(measured)
    if of["b"]:
        out["paired"] = pairs(rows)
    if any(row.difference for row in rows):
        out["differences"] = differences(of["a"])
    return out


# --- Markdown ----------------------------------------------------------------------------------------------------------------


def markdown(data: Dict[str, Any]) -> str:
    """The summary for people."""
    head = data["run"]
    lines = [f"# {head['environment']}: {head['a']}", ""]
    if "success" in data:
        lines += [*_success_table(data["success"], "task"), ""]
    if "success_b" in data:
        lines += ["B on the same episodes:", "", *_success_table(data["success_b"], "task"), ""]
    if "swapped" in data:
        lines += ["With the opposite task's sentence (solving the scene's own task is then a fault):", ""]
        lines += [*_success_table(data["swapped"], "scene"), ""]
    if "paired" in data:
        lines += _paired_text(data["paired"], head)
    if "differences" in data:
        lines += ["Largest difference of two chunks from the same observation and noise, by look:", "", *_difference_table(data), ""]
    if "smoothness" in data:
        lines += [*_smoothness_table(data, head), ""]
    lines += [*_latency_text(data["latency"], head), ""]
    return "\n".join(lines)


def _success_table(table: Dict[str, Dict[str, Any]], first: str) -> List[str]:
    lines = [f"| {first} | solved | rate | 95 % interval | median steps |", "|---|---:|---:|---|---:|"]
    for task, row in table.items():
        low, high = (100 * x for x in row["wilson95"])
        rate = "" if row["rate"] is None else f"{100 * row['rate']:.1f} %"
        steps = "" if row["median_steps"] is None else f"{row['median_steps']:g}"
        lines.append(f"| {task} | {row['solved']}/{row['episodes']} | {rate} | {low:.1f} to {high:.1f} % | {steps} |")
    return lines


def _paired_text(table: Dict[str, Any], head: Dict[str, Any]) -> List[str]:
    lines = [
        f"A is {head['a']}, B is {head['b']}, on the same layouts with the same noise:", "",
        "| episodes | both | only A | only B | neither | McNemar p | same number of steps |", "|---:|---:|---:|---:|---:|---:|---:|",
        f"| {table['episodes']} | {table['both']} | {table['only_a']} | {table['only_b']} | {table['neither']} "
        f"| {table['mcnemar_p']:.3g} | {table['same_length']} |", "",
    ]  # fmt: skip
    for row in table["discordant"]:
        who = "A" if row["a"] else "B"
        lines.append(f"- only {who} solved {row['task']}, seed {row['seed']} (A {row['a_steps']} steps, B {row['b_steps']})")
    return lines + ([""] if table["discordant"] else [])


def _smoothness_table(data: Dict[str, Any], head: Dict[str, Any]) -> List[str]:
    """Means over episodes, in action units and steps."""
    names = dict.fromkeys([*data["smoothness"], *data.get("smoothness_b", {})])
    lines = [f"| executed actions | {' | '.join(name.replace('_', ' ') for name in names)} |", "|---|" + "---:|" * len(names)]
    for key, policy in (("smoothness", head["a"]), ("smoothness_b", head["b"])):
        if key in data:
            lines.append(f"| {policy} | " + " | ".join(f"{data[key][n]:.3g}" if n in data[key] else "" for n in names) + " |")
    return lines


def _difference_table(data: Dict[str, Any]) -> List[str]:
    lines = ["| look | chunks | median | 95 % | max |", "|---:|---:|---:|---:|---:|"]
    return lines + [f"| {r['look']} | {r['chunks']} | {r['p50']:.1e} | {r['p95']:.1e} | {r['max']:.1e} |" for r in data["differences"]]


def _latency_text(row: Dict[str, Any], head: Dict[str, Any]) -> List[str]:
    if not row["engine_ms"]["p95"] > 0:
        return []  # nothing was inferred: random actions
    verdict = "keeps up with" if row["keeps_up"] else "is slower than"
    rate = f"{row['control_rate_hz']:.0f} steps per second, which {verdict} the robot's {head['rate_hz']:g}" if row["control_rate_hz"] else ""
    return [
        f"A replan takes {row['round_trip_ms']['p50']:.1f} ms (p95 {row['round_trip_ms']['p95']:.1f}), of which the engine "
        f"{row['engine_ms']['p50']:.1f} (p95 {row['engine_ms']['p95']:.1f}). With {head['replan_every']} steps a chunk that is "
        f"{row['amortised_ms']:.2f} ms a step: {rate}."
    ]

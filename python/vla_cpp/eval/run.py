# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What the subcommands of vla-eval share: policies from arguments, one run with its journal, films of its failures."""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Callable, Dict, Iterator, List, Optional

from ..output import write_text
from . import report
from .environment import Environment, Guard
from .environments import find, make
from .episode import Job, Outcome, run_episode
from .journal import Journal
from .policies import OPENPI, OpenpiPolicy, ServedPolicy, make_policy
from .runner import Plan, RunFailed, run_jobs
from .serving import Server

TIMEOUT = 60.0  # seconds for an answer: a large policy on a small machine takes its time


@dataclass
class Driver:
    """A policy under test: how a worker makes it, what people call it, and which weights it is."""

    description: Dict[str, Any]
    label: str
    identity: str
    spec: Any = None  # of `vla serve`


def no_fault() -> Optional[str]:
    return None


class Policies(contextlib.ExitStack):
    """The policies of a run and the servers that were started for them. All end with the `with` block."""

    def __init__(self, arguments: argparse.Namespace) -> None:
        super().__init__()
        self._arguments, self._servers = arguments, []  # type: ignore[var-annotated]

    def bundle(self, path: str) -> Driver:
        """A server of our own."""
        a = self._arguments
        server = self.enter_context(Server(a.vla, Path(path), a.threads, a.kernels))
        self._servers.append(server)
        return self.served(server.address)

    def served(self, address: str) -> Driver:
        """Errors: BadObservation, for a robot that the policy does not have, or none of several."""
        robot = self._arguments.embodiment
        description = {"kind": "served", "address": address, "timeout": TIMEOUT, "embodiment": robot}
        policy = make_policy(description)
        assert isinstance(policy, ServedPolicy)
        spec = policy.spec
        policy.close()
        precision = {"f32": "float32", "bf16": "bfloat16", "f16": "float16"}.get(spec.precision, spec.precision)
        label = f"{spec.bundle.name}{f' for {robot}' if robot else ''}, computed in {precision} with {spec.kernels} kernels"
        return Driver(description, label, spec.bundle.checksum, spec)

    def openpi(self, address: str) -> Driver:
        """A server of openpi's protocol. It does not say what its policy takes, so there is no spec."""
        description = {"kind": "openpi", "address": address, "timeout": TIMEOUT, "names": self._arguments.map or []}
        policy = make_policy(description)
        assert isinstance(policy, OpenpiPolicy)
        policy.close()
        return Driver(description, policy.label, policy.identity)

    def torch(self, checkpoint: str) -> Driver:
        from . import lerobot_reference

        identity = f"torch:{lerobot_reference.identity(checkpoint)}"
        return Driver({"kind": "torch", "checkpoint": str(Path(checkpoint).resolve())}, "PyTorch float32", identity)

    def named(self, text: str) -> Driver:
        """bundle FILE, tcp://ADDRESS, openpi://ADDRESS, torch:DIR, or random."""
        if text == "random":
            return Driver({"kind": "random", "horizon": 16}, "random actions", "random")
        if text.startswith("torch:"):
            return self.torch(text[len("torch:") :])
        if text.startswith(OPENPI):
            return self.openpi(text)
        return self.served(text) if "://" in text else self.bundle(text)

    def fault(self) -> Optional[str]:
        """Why a server that we started ended."""
        return next(filter(None, (server.fault() for server in self._servers)), None)


def options_of(kind: type, spec: Any) -> Dict[str, Any]:
    """What the adapter wants to know of the policy."""
    fit = getattr(kind, "fit", None)
    return fit(spec) if fit and spec else {}


def run(
    name: str,
    a: Driver,
    jobs: List[Job],
    folder: Path,
    *,
    b: Optional[Driver] = None,
    replan_every: int = 0,
    mode: str = "sync",
    latency_ms: float = 0.0,
    workers: int,
    title: str,
    fault: Callable[[], Optional[str]] = no_fault,
    quiet: bool = False,
) -> Dict[str, Any]:
    """Runs the jobs that are not on disk yet and returns the summary of all. Errors: RunFailed, JournalMismatch."""
    options = options_of(find(name), a.spec)
    declaration = find(name).declare(jobs[0].task, **options)
    size_random([a, b], declaration.d_action)
    stated = getattr(a.spec, "n_action_steps", 0) if a.spec else 0
    replan_every = _replan_every(replan_every, stated, declaration.replan_every)
    head = {
        "environment": name, "a": a.label, "a_identity": a.identity, "b": b.label if b else "", "b_identity": b.identity if b else "",
        "replan_every": replan_every, "limit": "by suite" if find(name).suites() else declaration.limit,
        "rate_hz": declaration.rate_hz, "conventions": declaration.conventions,
    }  # fmt: skip
    if stated:
        head["n_action_steps"] = stated
    drivers = {"a": a.description, **({"b": b.description} if b else {})}
    plan = Plan(name, options, drivers, "b" if b else None, replan_every, mode, latency_ms / 1e3)
    if not plan.waits:
        head.update(mode=mode, latency_ms=latency_ms)
    journal = Journal(folder, head)
    try:
        with progress(title, len(jobs), journal.outcomes, quiet) as on_episode:
            run_jobs(plan, jobs, journal, workers, on_episode, fault)
    finally:
        journal.close()
    # In the order of the jobs, not in that in which workers finished them: a table must not depend on who was faster.
    finished = {row.key: row for row in journal.outcomes}
    return report.summary([finished[job.key] for job in jobs], head)


def _replan_every(asked: int, stated: int, usual: int) -> int:
    """Steps executed of a chunk: asked for, or what the checkpoint executes, or the environment's usual number. Told, since success hangs on it."""
    chosen = asked or stated or usual
    if stated:
        why = "as the checkpoint" if chosen == stated else f"where the checkpoint executes {stated}: n_action_steps"
        print(f"steps executed of a chunk: {chosen}, {why}", file=sys.stderr)
    return chosen


def size_random(drivers: List[Optional[Driver]], d_action: int) -> None:
    """Random actions have no policy that says how wide they are: the environment does."""
    for driver in drivers:
        if driver and driver.description["kind"] == "random":
            driver.description["d_action"] = d_action


@contextlib.contextmanager
def progress(title: str, total: int, before: List[Outcome], quiet: bool) -> Iterator[Callable[[Outcome], None]]:
    """A bar on standard error, and lines where nobody watches."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    solved, count = sum(row.solved for row in before), len(before)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, disable=quiet) as bar:
        row = bar.add_task(title, total=total, completed=count)

        def on_episode(outcome: Outcome) -> None:
            nonlocal solved, count
            solved, count = solved + outcome.solved, count + 1
            bar.update(row, advance=1, description=f"{title}: {solved}/{count} solved, {outcome.engine_ms[-1]:.0f} ms a look")
            if not console.is_terminal and not quiet and count % 10 == 0:
                console.print(f"{title}: {count}/{total} episodes, {solved} solved")

        yield on_episode


def film_episodes(name: str, driver: Driver, rows: List[Outcome], folder: Path, names: List[str]) -> List[Path]:
    """Runs these episodes again, which are the same again, and films them. Returns the files."""
    from .film import Recorder, Scene, contact_sheet, film

    paths: List[Path] = []
    policy = make_policy(driver.description)
    environments: Dict[str, Environment] = {}
    for row in rows:
        if row.task not in environments:
            if environments and find(name).one_at_a_time:
                environments.popitem()[1].close()
            environments[row.task] = make(name, row.task, **options_of(find(name), driver.spec))
        environment = environments[row.task]
        view = next(iter(environment.declaration.views))
        recorder = Recorder(lambda: environment.observe().frames[view])
        job = Job(row.task, row.seed, "a", row.sentence if row.swapped else "")
        outcome = run_episode(Guard(environment), policy, job, row.replan_every, watcher=recorder.watcher())
        recorder.finish(outcome.steps)
        stem = folder / f"{row.task.replace('/', '-')}-{row.seed}{'-swapped' if row.swapped else ''}"
        title = f"{name} {row.task}, seed {row.seed}, {driver.label}"
        scene = Scene(recorder, outcome, names, title)
        paths.append(film([scene], stem, environment.declaration.rate_hz))
        contact_sheet(scene, stem.with_suffix(".png"))
    policy.close()
    return paths


def write_report(data: Dict[str, Any], folder: Path) -> None:
    """summary.json, summary.md and, with matplotlib, summary.png."""
    write_text(folder / "summary.json", json.dumps(data, indent=1) + "\n")
    write_text(folder / "summary.md", report.markdown(data))
    try:
        from . import plots
    except ImportError:
        return
    head = data["run"]
    kind, what = ("success", "solved") if "success" in data else ("swapped", "solved though the opposite was asked for")
    tables = {head["a"]: data[kind], **({head["b"]: data[kind + "_b"]} if head["b"] else {})}
    plots.success_bars(tables, f"{head['environment']}: {what}, with 95 % intervals", folder / "summary.png")
    if "differences" in data:
        title = f"{head['a']},\nagainst {head['b']}: largest difference of two chunks, action units"
        plots.difference_curves(data["differences"], title, folder / "differences.png")


__all__ = ["Policies", "RunFailed", "film_episodes", "run", "write_report"]

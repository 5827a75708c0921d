# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""vla-eval demo: one sentence, a robot in a simulator, and a film of what it did."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any, List

from .environments import MissingSimulator, make
from .environments.metaworld import SENTENCES
from .episode import Job, Look, Outcome, Watcher, run_episode
from .environment import Guard


def add_command(commands: Any) -> None:
    parser = commands.add_parser(
        "demo", help="say a sentence, watch the robot, get a film", formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Serves a bundle, tells it a sentence in a MetaWorld scene that it has never seen, shows every look while it runs,\n"
        "writes a film and a contact sheet, then counts a few more layouts.",
    )  # fmt: skip
    parser.add_argument("--bundle", default="models/metaworld-tiny.gguf", metavar="FILE")
    parser.add_argument("--embodiment", metavar="TAG", help="the robot, where the bundle is for several")
    parser.add_argument("--text", default="open the faucet", help="the sentence (default: open the faucet)")
    parser.add_argument("--task", choices=list(SENTENCES), help="the scene (default: the one that the sentence belongs to)")
    parser.add_argument("--seed", type=int, default=910000, help="of the layout that is filmed (default 910000)")
    parser.add_argument("--episodes", type=int, default=8, help="further layouts to count (default 8)")
    parser.add_argument("--out", type=Path, default=Path("out/demo"), metavar="DIR")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--kernels", default="")
    parser.add_argument("--vla", default="", metavar="FILE", help="the program `vla` (default: VLA_BINARY, or the PATH's)")


def play(a: argparse.Namespace) -> int:
    from rich.console import Console

    from . import run as runs
    from .film import Recorder, contact_sheet, film
    from .policies import make_policy

    console = Console()
    task = a.task or next((task for task, sentence in SENTENCES.items() if sentence == a.text), None)
    if task is None:
        told = ", ".join(f'"{sentence}"' for sentence in SENTENCES.values())
        print(f"vla-eval demo: the policy knows {told}; for another sentence name the scene with --task", file=sys.stderr)
        return 2
    a.out.mkdir(parents=True, exist_ok=True)
    with runs.Policies(a) as policies:
        driver = policies.bundle(a.bundle)
        spec = driver.spec
        console.print(f"[bold]{spec.bundle.name}[/] ({spec.bundle.arch}) serves on {spec.device}, kernels: {spec.kernels}", highlight=False)
        console.print(f"MetaWorld [bold]{task}[/], layout {a.seed}. The robot hears: [bold yellow]“{a.text}”[/]", highlight=False)
        environment = _scene(task)
        policy = make_policy(driver.description)
        recorder = Recorder("corner4", environment.frame)  # type: ignore[attr-defined]
        told = _Teller(console, recorder.watcher(), spec.action_names)
        sentence = "" if a.text == environment.instruction() else a.text
        outcome = run_episode(Guard(environment), policy, Job(task, a.seed, "a", sentence), environment.declaration.replan_every, watcher=told)
        recorder.finish(outcome.steps)
        policy.close()
        console.print(_verdict(outcome), highlight=False)
        title = f"MetaWorld {task}, seed {a.seed}"
        stem = a.out / f"{task}-{a.seed}"
        path = film(recorder, outcome, spec.action_names, title, stem, environment.declaration.rate_hz)
        contact_sheet(recorder, outcome, spec.action_names, title, stem.with_suffix(".png"))
        console.print(f"film: {path}\ncontact sheet: {stem.with_suffix('.png')}", highlight=False, soft_wrap=True)
        if a.episodes:
            _count(a, policies, driver, task, sentence, console)
    return 0


def _scene(task: str) -> Any:
    try:
        return make("metaworld", task)
    except MissingSimulator as error:
        raise MissingSimulator(f"{error}\nWithout a simulator, with recorded camera frames: make demo RECORDED=1") from error


def _count(a: argparse.Namespace, policies: Any, driver: Any, task: str, sentence: str, console: Any) -> None:
    from . import run as runs

    jobs = [Job(task, a.seed + 1 + e, "a", sentence) for e in range(a.episodes)]
    journal = a.out / "episodes.jsonl"
    if journal.exists():
        journal.unlink()  # a demo is shown again, not continued
    data = runs.run("metaworld", driver, jobs, a.out, workers=a.workers, title=f"{a.episodes} more layouts", fault=policies.fault)
    row = data["swapped" if sentence else "success"]
    low, high = (100 * x for x in row["all"]["wilson95"])
    t = data["latency"]["round_trip_ms"]
    what = f"solved the scene's task in {row['all']['solved']} of {row['all']['episodes']} layouts (95 % interval {low:.0f} to {high:.0f} %)"
    console.print(f"{what}; from frame to chunk, server included, {t['p50']:.0f} ms, p95 {t['p95']:.0f}", highlight=False, soft_wrap=True)


class _Teller(Watcher):
    """Says each look as it happens, one line, and passes it on to the film."""

    def __init__(self, console: Any, inner: Watcher, names: List[str]) -> None:
        self._console, self._names, self._count = console, names, 0
        super().__init__(on_look=lambda look: (inner.on_look(look), self._say(look)), on_step=inner.on_step)

    def _say(self, look: Look) -> None:
        self._count += 1
        mean = look.answer.actions[:8].mean(axis=0)
        told = "  ".join(f"{name} {value:+.2f}" for name, value in zip(self._names, mean))
        self._console.print(f"look {self._count:2d}  step {look.step:3d}  {look.answer.engine_ms:6.1f} ms   {told}", highlight=False)


def _verdict(outcome: Outcome) -> str:
    if outcome.solved:
        return f"[bold green]solved after {outcome.steps} steps[/]"
    return f"[bold red]the scene's own task is not solved after {outcome.steps} steps[/]"



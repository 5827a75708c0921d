# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""vla-eval demo: sentences, a robot in a simulator, and a film of what it did."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any, List

from .environments import MissingSimulator, make
from .environments.metaworld import RATE_HZ, SENTENCES
from .episode import Job, Look, Outcome, Watcher, run_episode
from .environment import Guard


SHOWN = ("faucet-open", "drawer-close", "faucet-close")


def add_command(commands: Any) -> None:
    parser = commands.add_parser(
        "demo", help="say a sentence, watch the robot, get a film", formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Serves a bundle, tells it a sentence in each of a few MetaWorld scenes that it has never seen, shows every look while it\n"
        "runs, writes a film and a contact sheet, then counts a few more layouts of the first scene.",
    )  # fmt: skip
    parser.add_argument("--bundle", default="models/metaworld-tiny.gguf", metavar="FILE")
    parser.add_argument("--embodiment", metavar="TAG", help="the robot, where the bundle is for several")
    parser.add_argument("--text", help=f"one sentence (default, a scene for each: {', '.join(SENTENCES[task] for task in SHOWN)})")
    parser.add_argument("--task", choices=list(SENTENCES), help="the scene (default: the one that the sentence belongs to)")
    parser.add_argument("--gif", action="store_true", help="write the film as GIF too")
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
    from .film import contact_sheet, film

    console = Console()
    task = a.task or next((task for task, sentence in SENTENCES.items() if sentence == a.text), None)
    if a.text and task is None:
        told = ", ".join(f'"{sentence}"' for sentence in SENTENCES.values())
        print(f"vla-eval demo: the policy knows {told}; for another sentence name the scene with --task", file=sys.stderr)
        return 2
    a.out.mkdir(parents=True, exist_ok=True)
    tasks = [task] if task else list(SHOWN)
    with runs.Policies(a) as policies:
        driver = policies.bundle(a.bundle)
        spec = driver.spec
        console.print(f"[bold]{spec.bundle.name}[/] ({spec.bundle.arch}) serves on {spec.device}, kernels: {spec.kernels}", highlight=False)
        scenes = [_play_scene(task, a, driver, console) for task in tasks]
        stem = a.out / f"{'-'.join(tasks)}-{a.seed}"
        path = film(scenes, stem, RATE_HZ, a.gif)
        contact_sheet(scenes[0], stem.with_suffix(".png"))
        console.print(f"film: {path}\ncontact sheet: {stem.with_suffix('.png')}", highlight=False, soft_wrap=True)
        if a.episodes:
            _count(a, policies, driver, tasks[0], scenes[0].outcome.sentence if scenes[0].outcome.swapped else "", console)
    return 0


def _play_scene(task: str, a: argparse.Namespace, driver: Any, console: Any) -> Any:
    """The scene with what was recorded of it."""
    from .film import Recorder, Scene
    from .policies import make_policy

    environment = _scene(task)
    sentence = a.text or environment.instruction()
    console.print(f"MetaWorld [bold]{task}[/], layout {a.seed}. The robot hears: [bold yellow]“{sentence}”[/]", highlight=False)
    policy = make_policy(driver.description)
    recorder = Recorder(environment.picture)
    told = _Teller(console, recorder.watcher(), driver.spec.action_names)
    other = "" if sentence == environment.instruction() else sentence
    outcome = run_episode(Guard(environment), policy, Job(task, a.seed, "a", other), environment.declaration.replan_every, watcher=told)
    recorder.finish(outcome.steps)
    policy.close()
    console.print(_verdict(outcome), highlight=False)
    return Scene(recorder, outcome, driver.spec.action_names, f"MetaWorld {task}, seed {a.seed}")


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



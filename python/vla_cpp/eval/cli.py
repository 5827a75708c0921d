# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""vla-eval: counts what a policy achieves in a simulator, and shows it."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any, Dict, List, Optional

from ..errors import BadObservation, UsageError, VlaError
from ..installed import extra_hint
from ..output import write_text
from .environment import EnvironmentFault
from .environments import NAMES, MissingSimulator, find, no_task
from .episode import Job
from .journal import JournalMismatch
from .policies import OPENPI
from .runner import RunFailed
from .serving import ServerFailed

EPILOG = """examples:
  vla-eval metaworld --bundle models/metaworld-tiny.gguf --episodes 50
  vla-eval metaworld --bundle policy.gguf --against torch:./checkpoint --paired --episodes 50
  vla-eval replan --bundle policy.gguf --intervals 1,2,4,8,16
Episodes go to OUT/episodes.jsonl one by one; the same command after a kill runs those that are missing.
Exit codes: 0 done, 2 usage, 9 the run ended early (its episodes so far are kept)."""


def _common(parser: argparse.ArgumentParser) -> None:
    who = parser.add_argument_group("the policy, one of")
    who.add_argument("--bundle", metavar="FILE", help="serve this bundle for the run")
    who.add_argument("--server", metavar="ADDRESS", help="use a running `vla serve`, e.g. tcp://127.0.0.1:5555, or with --map a server of openpi's protocol, e.g. openpi://127.0.0.1:8000")
    who.add_argument("--torch", metavar="DIR", help="a LeRobot checkpoint, in PyTorch float32")
    who.add_argument("--embodiment", metavar="TAG", help="the robot, where the bundle is for several")
    who.add_argument("--map", action="append", metavar="KEY=NAME", help="of openpi's protocol: a key that the server takes, and the view, state or `text` that it stands for; several times")
    who.add_argument("--random", action="store_true", help="uniform actions: the floor that a policy must leave")
    parser.add_argument("--episodes", type=int, default=20, help="of each task (default 20)")
    parser.add_argument("--task", action="append", metavar="NAME", help="only this task; may be given again (default: all)")
    parser.add_argument("--seed", type=int, default=900000, help="of the first episode; the next ones count up (default 900000)")
    parser.add_argument("--out", type=Path, metavar="DIR", help="where episodes and reports go (default out/eval/ and the command's name)")
    parser.add_argument("--workers", type=int, default=2, help="simulator processes (default 2)")
    parser.add_argument("--threads", type=int, default=1, help="of the server that is started for --bundle; 0: every core (default 1)")
    parser.add_argument("--kernels", default="", help="of that server: ggml, portable, neon, neon_bf16, avx2, avx512, avx512_bf16, amx, float32, bf16, int8, int4 (default: the best for the bundle's dtype)")
    parser.add_argument("--vla", default="", metavar="FILE", help="the program `vla` (default: VLA_BINARY, or the PATH's)")
    parser.add_argument("--json", action="store_true", help="end with the summary as one JSON object on standard output")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")


def _suites(parser: argparse.ArgumentParser, suites: Dict[str, List[str]]) -> None:
    text = f"every task of these suites, with commas, e.g. object,spatial; there are: {', '.join(map(_short, suites))}"
    parser.add_argument("--suite", metavar="NAMES", help=text)


def build_parser() -> argparse.ArgumentParser:
    formatter = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("vla-eval", description=__doc__, epilog=EPILOG, formatter_class=formatter)
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name in NAMES:
        text = {"metaworld": "four MetaWorld tasks", "libero": "LIBERO and LIBERO-PRO, by suite", "aloha": "two arms that hand a cube over", "null": "no simulator: tries the harness"}[name]
        command = commands.add_parser(name, help=text, description=(find(name).__doc__ or text), formatter_class=formatter)
        _common(command)
        if find(name).suites():
            _suites(command, find(name).suites())
        command.add_argument("--replan-every", type=int, default=0, metavar="S", help="steps executed of a chunk (default: the checkpoint's n_action_steps, or else the environment's)")
        command.add_argument("--mode", choices=("sync", "async", "rtc"), default="sync", help="how chunks follow each other: the robot waits for each; it goes on with the one before meanwhile; the same, and the policy goes on from its rows (default sync)")
        command.add_argument("--latency-ms", type=float, default=0.0, metavar="MS", help="let this time of the simulator pass between an observation and its chunk (default 0)")
        command.add_argument("--against", metavar="POLICY", help="compare with torch:DIR, another bundle, a server's address, or random")
        command.add_argument("--paired", action="store_true", help="with --against: the same seeds and noise, and every chunk of both at the same looks")
        command.add_argument("--swap", action="store_true", help="give each task the sentence of its opposite: solving the scene's own task is then a fault")
        command.add_argument("--film", choices=("none", "failures", "all"), default="none", help="film these episodes (needs pillow)")
    replan = commands.add_parser("replan", help="success, latency and control rate against the replan interval", formatter_class=formatter)
    _common(replan)
    replan.add_argument("--intervals", default="1,2,4,8,16", help="steps executed of a chunk (default 1,2,4,8,16)")
    replan.add_argument("--environment", choices=NAMES, default="metaworld")
    _suites(replan, {suite: tasks for name in NAMES for suite, tasks in find(name).suites().items()})
    from . import demo

    demo.add_command(commands)
    return parser


def _driver(policies: Any, a: argparse.Namespace) -> Any:
    given = [x for x in (a.bundle, a.server, a.torch and f"torch:{a.torch}", "random" if a.random else None) if x]
    if len(given) != 1:
        raise SystemExit(_usage("give one of --bundle, --server, --torch and --random"))
    is_openpi = given[0].startswith(OPENPI)
    if a.embodiment is not None and (is_openpi or not (a.bundle or a.server)):
        raise SystemExit(_usage("--embodiment goes with --bundle or --server, not with openpi's protocol"))
    if bool(a.map) != any((text or "").startswith(OPENPI) for text in (given[0], getattr(a, "against", None))):
        raise SystemExit(_usage("--map KEY=NAME goes with a server of openpi's protocol, which needs it"))
    return policies.named(given[0])


def _usage(text: str) -> int:
    print(f"vla-eval: {text}; vla-eval --help explains", file=sys.stderr)
    return 2


def _jobs(name: str, a: argparse.Namespace) -> List[Job]:
    kind = find(name)
    tasks = (a.task or []) + _of_suites(name, kind.suites(), getattr(a, "suite", None) or "")
    if not tasks and kind.suites():
        raise SystemExit(_usage(f"{name} has {len(kind.tasks())} tasks: give --suite or --task"))
    tasks = tasks or kind.tasks()
    unknown = [task for task in tasks if task not in kind.tasks()]
    if unknown or a.episodes < 1 or a.workers < 1:
        what = no_task(name, unknown[0]) if unknown else "--episodes and --workers take 1 or more"
        raise SystemExit(_usage(what))
    if kind.one_at_a_time:
        return [Job(task, a.seed + e) for task in tasks for e in range(a.episodes)]
    return [Job(task, a.seed + e) for e in range(a.episodes) for task in tasks]


def _short(suite: str) -> str:
    """`object` for `libero_object`: a suite without the simulator's name before it."""
    return suite.partition("_")[2]


def _of_suites(name: str, suites: Dict[str, List[str]], given: str) -> List[str]:
    named = {**suites, **{_short(suite): tasks for suite, tasks in suites.items()}}
    wanted = [part.strip() for part in given.split(",") if part.strip()]
    for suite in wanted:
        if suite not in named:
            others = f"there are: {', '.join(map(_short, suites))}" if suites else "it has no suites"
            raise SystemExit(_usage(f"--suite: {name} has no '{suite}'; {others}"))
    return [task for suite in wanted for task in named[suite]]


def _swapped(name: str, jobs: List[Job]) -> List[Job]:
    module = sys.modules[find(name).__module__]
    opposite: Dict[str, str] = getattr(module, "OPPOSITE", {})
    swapped = [Job(job.task, job.seed, job.driver, module.SENTENCES[opposite[job.task]]) for job in jobs if job.task in opposite]
    if not swapped:
        raise SystemExit(_usage(f"--swap: no task of {name} here has an opposite"))
    return swapped


def evaluate(name: str, a: argparse.Namespace) -> Dict[str, Any]:
    from . import run as runs

    if a.paired != bool(a.against):
        raise SystemExit(_usage("--against POLICY and --paired go together"))
    if not 0 <= a.latency_ms < 1e5:
        raise SystemExit(_usage(f"--latency-ms: expected 0 or more, found {a.latency_ms:g}"))
    delayed = a.mode != "sync" or a.latency_ms > 0
    if delayed and (a.against or a.film != "none" or not (a.bundle or a.server) or (a.server or "").startswith(OPENPI)):
        raise SystemExit(_usage("--mode and --latency-ms go with --bundle or --server of vla's own protocol, and not with --against and --film"))
    jobs = _jobs(name, a)
    if a.swap:
        jobs = _swapped(name, jobs)
    folder = a.out or Path("out/eval") / name
    with runs.Policies(a) as policies:
        driver = _driver(policies, a)
        other = policies.named(a.against) if a.against else None
        if other:
            jobs = jobs + [Job(job.task, job.seed, "b", job.sentence) for job in jobs]
        data = runs.run(
            name, driver, jobs, folder, b=other, replan_every=a.replan_every, mode=a.mode, latency_ms=a.latency_ms, workers=a.workers, title=name,
            fault=policies.fault, quiet=a.quiet,
        )  # fmt: skip
        runs.write_report(data, folder)
        if a.film != "none":
            _film(name, driver, folder, a)
    return data


def _film(name: str, driver: Any, folder: Path, a: argparse.Namespace) -> None:
    from . import run as runs
    from .episode import Outcome

    lines = (folder / "episodes.jsonl").read_text(encoding="utf-8").splitlines()[1:]
    rows = [row for row in (Outcome(**json.loads(line)) for line in lines) if row.driver == "a"]
    wrong = [row for row in rows if row.solved == row.swapped]
    names = list(driver.spec.action_names) if driver.spec else [f"action {i}" for i in range(99)]
    for path in runs.film_episodes(name, driver, rows if a.film == "all" else wrong, folder, names):
        print(f"film: {path}", file=sys.stderr)


def replan(a: argparse.Namespace) -> Dict[str, Any]:
    from . import run as runs

    try:
        intervals = [int(text) for text in a.intervals.split(",")]
    except ValueError:
        raise SystemExit(_usage(f"--intervals: expected numbers with commas, found {a.intervals}")) from None
    folder = a.out or Path("out/eval/replan")
    rows: List[Dict[str, Any]] = []
    with runs.Policies(a) as policies:
        driver = _driver(policies, a)
        if driver.spec and not all(1 <= s <= driver.spec.horizon for s in intervals):
            raise SystemExit(_usage(f"--intervals: expected 1 to {driver.spec.horizon}, the rows of a chunk, found {a.intervals}"))
        for s in intervals:
            data = runs.run(
                a.environment, driver, _jobs(a.environment, a), folder / f"S{s}", replan_every=s, workers=a.workers, title=f"S = {s}",
                fault=policies.fault, quiet=a.quiet,
            )  # fmt: skip
            rows.append({"replan_every": s, "success": data["success"]["all"], "latency": data["latency"]})
    summary = {"run": {**data["run"], "replan_every": intervals}, "intervals": rows}
    text = "\n".join(replan_table(rows))
    write_text(folder / "summary.md", text + "\n")
    write_text(folder / "summary.json", json.dumps(summary, indent=1) + "\n")
    try:
        from . import plots
    except ImportError:
        print("no plot: pip install matplotlib", file=sys.stderr)
    else:
        plots.replan_curves(rows, data["run"]["rate_hz"], f"{a.environment}: {driver.label}", folder / "summary.png")
    summary["markdown"] = text
    return summary


def replan_table(rows: List[Dict[str, Any]]) -> List[str]:
    lines = ["| S | solved | 95 % interval | replan p50, ms | p95 | ms a step | steps per second |", "|---:|---:|---|---:|---:|---:|---:|"]
    for row in rows:
        s, t = row["success"], row["latency"]
        low, high = (100 * x for x in s["wilson95"])
        lines.append(
            f"| {row['replan_every']} | {s['solved']}/{s['episodes']} | {low:.0f} to {high:.0f} % | {t['round_trip_ms']['p50']:.1f} "
            f"| {t['round_trip_ms']['p95']:.1f} | {t['amortised_ms']:.2f} | {t['control_rate_hz']:.0f} |"
        )
    return lines


def main(argv: Optional[List[str]] = None) -> int:
    a = build_parser().parse_args(argv)
    try:
        if a.command == "demo":
            from . import demo

            return demo.play(a)
        data = replan(a) if a.command == "replan" else evaluate(a.command, a)
    except ModuleNotFoundError as error:
        package = str(error.name).partition(".")[0]
        print(f"vla-eval: the module {package} is missing; {extra_hint('eval')}", file=sys.stderr)
        return 9
    except (BadObservation, UsageError) as error:
        return _usage(str(error))
    except (RunFailed, JournalMismatch, EnvironmentFault, MissingSimulator, ServerFailed, VlaError, ImportError) as error:
        print(f"vla-eval: {error}", file=sys.stderr)
        if isinstance(error, RunFailed):
            print("vla-eval: episodes that ended are kept; the same command runs the missing ones", file=sys.stderr)
        return 9
    except KeyboardInterrupt:
        print("vla-eval: stopped; the same command goes on", file=sys.stderr)
        return 130
    from . import report

    text = data.pop("markdown", None) or report.markdown(data)
    print(text, file=sys.stderr if a.json else sys.stdout)
    if a.json:
        print(json.dumps(data))
    return 0


if __name__ == "__main__":
    sys.exit(main())

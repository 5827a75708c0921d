# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Runs many episodes side by side: simulators in processes of their own, all at one server."""

from __future__ import annotations

import multiprocessing
import os
import queue
import sys
import traceback
from dataclasses import dataclass
from typing import Any, Callable, Dict, List, Optional

from .environment import EnvironmentFault, Guard
from .episode import Job, Outcome, run_episode
from .journal import Journal
from .policies import EvalPolicy
from .serving import die_with_parent


class RunFailed(Exception):
    """A run that ended early. What was finished is in the journal; the same command goes on from there."""


@dataclass(frozen=True)
class Plan:
    """What a worker process must know. policies: by driver, see make_policy. shadow: whose chunks are compared with the driver's."""

    environment: str
    options: Dict[str, Any]
    policies: Dict[str, Dict[str, Any]]
    shadow: Optional[str]
    replan_every: int
    mode: str = "sync"
    latency: float = 0.0  # seconds; with any, or a mode other than sync, the simulator does not wait for the policy

    @property
    def waits(self) -> bool:
        return self.mode == "sync" and self.latency == 0


def _run(plan: Plan, guard: Guard, policies: Dict[str, EvalPolicy], job: Job) -> Outcome:
    if not plan.waits:
        from .delayed import run_delayed

        return run_delayed(guard, policies[job.driver], job, plan.replan_every, plan.mode, plan.latency)
    shadow = policies[plan.shadow] if plan.shadow and plan.shadow != job.driver else None
    return run_episode(guard, policies[job.driver], job, plan.replan_every, shadow)


def _work(plan: Plan, jobs: Any, results: Any) -> None:
    """One process: takes jobs until a None comes. Failures are reported with their job."""
    die_with_parent()
    # Simulator and policy libraries start threads that would take the cores from the other workers.
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    from .environments import MissingSimulator, find, make
    from .policies import make_policy

    job: Optional[Job] = None
    try:
        policies = {driver: make_policy(description) for driver, description in plan.policies.items()}
        guards: Dict[str, Guard] = {}
        while True:
            job = jobs.get()
            if job is None:
                break
            if job.task not in guards:
                if guards and find(plan.environment).one_at_a_time:
                    guards.popitem()[1].inner.close()
                guards[job.task] = Guard(make(plan.environment, job.task, **plan.options))
            results.put(("done", _run(plan, guards[job.task], policies, job)))
        results.put(("end", None))
    except (EnvironmentFault, MissingSimulator, ImportError, ValueError) as error:
        results.put(("fault", f"{_where(job)}{error}"))
    except Exception as error:  # the policy's errors, and what a simulator raises
        known = type(error).__module__.startswith("vla_cpp")
        results.put(("fault", f"{_where(job)}{error}" if known else f"{_where(job)}{traceback.format_exc()}"))
    results.close()
    results.join_thread()
    sys.stdout.flush()
    os._exit(0)  # MuJoCo's destructors print errors at a normal exit


def _where(job: Optional[Job]) -> str:
    return "" if job is None else f"{job.task}, seed {job.seed}: "


def run_jobs(
    plan: Plan,
    todo: List[Job],
    journal: Journal,
    n_worker: int,
    on_episode: Callable[[Outcome], None],
    server_fault: Callable[[], Optional[str]],
) -> None:
    """Runs those jobs that the journal does not hold yet. server_fault tells why the server ended, if it did.

    Errors: RunFailed, with the first thing that went wrong; episodes under way are not counted then.
    """
    finished = {outcome.key for outcome in journal.outcomes}
    todo = [job for job in todo if job.key not in finished]
    if not todo:
        return
    context = multiprocessing.get_context("spawn")
    jobs, results = context.Queue(), context.Queue()
    n_worker = min(n_worker, len(todo))
    for job in todo:
        jobs.put(job)
    for _ in range(n_worker):
        jobs.put(None)
    workers = [context.Process(target=_work, args=(plan, jobs, results), daemon=True) for _ in range(n_worker)]
    for worker in workers:
        worker.start()
    try:
        _collect(results, workers, journal, on_episode, server_fault)
    finally:
        for worker in workers:
            worker.terminate()
        for worker in workers:
            worker.join()


def _collect(results: Any, workers: List[Any], journal: Journal, on_episode: Any, server_fault: Any) -> None:
    running = len(workers)
    while running:
        try:
            kind, what = results.get(timeout=1.0)
        except queue.Empty:
            fault = server_fault()
            if fault:
                raise RunFailed(fault)
            if not any(worker.is_alive() for worker in workers):
                raise RunFailed("the worker processes stopped without a word; was the machine out of memory?")
            continue
        if kind == "done":
            journal.add(what)
            on_episode(what)
        elif kind == "end":
            running -= 1
        else:
            raise RunFailed("\n".join(filter(None, [server_fault(), what])))

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""One closed-loop episode: look, predict a chunk, execute its first steps, look again."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any, Callable, Dict, List, Optional

import numpy as np

from .environment import Guard, Observation
from .policies import Answer, EvalPolicy


def noise_of(seed: int, replan: int, horizon: int, d_noise: int) -> np.ndarray:
    """(horizon, d_noise) float32: where the solver starts at this look of this episode. Every policy gets the same, so that their
    chunks can be compared and a resumed run repeats itself."""
    return np.random.default_rng([seed, replan]).standard_normal((horizon, d_noise), dtype=np.float32)


@dataclass(frozen=True)
class Job:
    """An episode to run. `driver` names the policy whose actions are executed; `sentence` is empty for the task's own."""

    task: str
    seed: int
    driver: str = "a"
    sentence: str = ""

    @property
    def key(self) -> str:
        return f"{self.driver}/{self.task}/{self.seed}/{self.sentence}"


@dataclass
class Look:
    """What one look saw and what was predicted from it; kept for films."""

    step: int
    observation: Observation
    answer: Answer
    executed: int = 0


@dataclass
class Watcher:
    """Called while an episode runs. `on_step` gets the step's number before its action is executed."""

    on_look: Callable[[Look], None] = lambda look: None
    on_step: Callable[[int], None] = lambda step: None


@dataclass
class Outcome:
    """A finished episode, as one line of the journal."""

    task: str
    seed: int
    driver: str
    sentence: str
    swapped: bool
    solved: bool
    steps: int
    clipped: int  # executed actions that the declared range cut
    replan_every: int
    round_trip_ms: List[float] = field(default_factory=list)
    engine_ms: List[float] = field(default_factory=list)
    difference: List[float] = field(default_factory=list)  # largest of each chunk to the shadow's, in action units
    bundle: str = ""
    facts: Dict[str, float] = field(default_factory=dict)
    smoothness: Dict[str, float] = field(default_factory=dict)  # of the executed actions

    @property
    def key(self) -> str:
        return Job(self.task, self.seed, self.driver, self.sentence if self.swapped else "").key


def run_episode(
    guard: Guard,
    policy: EvalPolicy,
    job: Job,
    replan_every: int,
    shadow: Optional[EvalPolicy] = None,
    watcher: Optional[Watcher] = None,
) -> Outcome:
    """Runs a job to its end. The shadow, if there is one, predicts at every look too; only its distance is kept.

    Errors: EnvironmentFault, and what the policies raise; the episode then does not count.
    """
    watcher = watcher or Watcher()
    guard.reset(job.seed)
    text = job.sentence or guard.instruction()
    out = Outcome(
        task=job.task, seed=job.seed, driver=job.driver, sentence=text, swapped=bool(job.sentence), solved=False, steps=0,
        clipped=0, replan_every=replan_every, bundle=policy.identity,
    )  # fmt: skip
    while out.steps < guard.declaration.limit and not out.solved:
        look = _look(guard, policy, text, noise_of(job.seed, len(out.engine_ms), *policy.noise_shape), out)
        if shadow is not None:
            noise = noise_of(job.seed, len(out.engine_ms) - 1, *shadow.noise_shape)
            other = shadow.act(look.observation, text, noise).actions
            out.difference.append(float(np.abs(other - look.answer.actions).max()))
        watcher.on_look(look)
        guard.begin_chunk()
        for action in look.answer.actions[:replan_every]:
            watcher.on_step(out.steps)
            out.solved, out.steps = guard.step(action), out.steps + 1
            look.executed += 1
            if out.solved or out.steps == guard.declaration.limit:
                break
    out.clipped, out.smoothness = guard.clipped, guard.smoothness()
    out.facts = facts_of(guard)
    return out


def _look(guard: Guard, policy: EvalPolicy, text: str, noise: np.ndarray, out: Outcome) -> Look:
    observation = guard.observe()
    begin = time.perf_counter()
    answer = policy.act(observation, text, noise)
    out.round_trip_ms.append(round(1e3 * (time.perf_counter() - begin), 3))
    out.engine_ms.append(round(answer.engine_ms, 3))
    if answer.actions.ndim != 2 or answer.actions.shape[1] != guard.declaration.d_action:
        raise ValueError(f"{guard.label}: takes {guard.declaration.d_action} values an action, the policy gave {answer.actions.shape}")
    return Look(out.steps, observation, answer)


def facts_of(guard: Guard) -> Dict[str, Any]:
    facts = getattr(guard.inner, "facts", None)
    return facts() if facts else {}

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""An episode in which every chunk comes a stated time after its observation, as if the policy ran on a slower machine.

Time is the simulator's: a period passes with each of its steps, and the latency is added to it, however long the policy really took. So a
run is reproducible on a busy machine.
"""

from __future__ import annotations

from typing import Any, Callable, Dict

import numpy as np

from ..control import ChunkLoop, RealTimeChunking
from .environment import Guard, Observation
from .episode import Job, Outcome, facts_of, noise_of
from .policies import EvalPolicy

MODES = ("sync", "async", "rtc")
GUIDED = {"schedule": "linear", "max_guidance": 10.0}  # the defaults of LeRobot's RTCConfig


class Clock:
    """Seconds that pass only when somebody waits."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


class _Pending:
    """A chunk that is there at a time of the clock."""

    def __init__(self, chunk: Any, clock: Clock, ready: float) -> None:
        self._chunk, self._clock, self._ready = chunk, clock, ready

    def done(self) -> bool:
        return self._clock.now >= self._ready - 1e-9

    def result(self) -> Any:
        self._clock.now = max(self._clock.now, self._ready)
        return self._chunk


class Delayed:
    """A served policy as ChunkLoop takes it, whose answers come `latency` seconds after the question."""

    def __init__(self, policy: EvalPolicy, clock: Clock, latency: float, noise: Callable[[], np.ndarray], out: Outcome) -> None:
        self.spec = policy.spec  # type: ignore[attr-defined]
        self._policy, self._clock, self._latency, self._noise, self._out = policy, clock, latency, noise, out

    def submit(self, observation: Observation, text: str, leftover: Any = None) -> _Pending:
        chunk = self._policy.chunk(observation, text, self._noise(), leftover)  # type: ignore[attr-defined]
        self._out.round_trip_ms.append(1e3 * self._latency)
        self._out.engine_ms.append(round(sum(chunk.timing.values()), 3))
        return _Pending(chunk, self._clock, self._clock.now + self._latency)


def rtc_of(spec: Any, replan_every: int) -> RealTimeChunking:
    """All rows that are left of a chunk go along."""
    guided: Dict[str, Any] = GUIDED if spec.real_time_chunking == "guided" else {}
    return RealTimeChunking(overlap=max(1, spec.horizon - replan_every), **guided)


def run_delayed(guard: Guard, policy: EvalPolicy, job: Job, replan_every: int, mode: str, latency: float) -> Outcome:
    """Runs a job to its end; while no action is there, zeros are commanded. Errors: those of run_episode."""
    guard.reset(job.seed)
    declaration, text = guard.declaration, job.sentence or guard.instruction()
    out = Outcome(
        task=job.task, seed=job.seed, driver=job.driver, sentence=text, swapped=bool(job.sentence), solved=False, steps=0,
        clipped=0, replan_every=replan_every, bundle=policy.identity,
    )  # fmt: skip
    clock = Clock()
    delayed = Delayed(policy, clock, latency, lambda: noise_of(job.seed, len(out.engine_ms), *policy.noise_shape), out)
    loop = ChunkLoop(
        delayed, rate_hz=declaration.rate_hz, replan_every=replan_every, mode=mode, blend="replace", on_late="zero", on_note="ignore",
        rtc=rtc_of(delayed.spec, replan_every) if mode == "rtc" else None, allow_other_rate=True, clock=clock, sleep=clock.sleep,
    )  # fmt: skip

    def observe() -> Dict[str, Any]:
        return {"observation": guard.observe(), "text": text}

    def execute(action: np.ndarray) -> None:
        if not out.solved and out.steps < declaration.limit:
            out.solved, out.steps = guard.step(action), out.steps + 1

    loop.begin(observe)
    chunk = None  # that the last action came from
    while out.steps < declaration.limit and not out.solved:
        missed = loop.stats["missed"]
        action = loop.step(observe)
        for _ in range(loop.stats["missed"] - missed):  # the robot stood while `step` waited
            execute(np.zeros(declaration.d_action, np.float32))
        if action.chunk is not None and action.chunk is not chunk:
            chunk = action.chunk
            guard.begin_chunk()
        execute(action.values)
        loop.pace()
    out.clipped, out.smoothness = guard.clipped, guard.smoothness()
    out.facts = {**facts_of(guard), "held": float(loop.stats["held"])}
    return out

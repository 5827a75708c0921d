# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Runs a ChunkSchedule: requests chunks from a policy and keeps the control rate."""

from __future__ import annotations

import logging
import math
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Callable, Dict, Mapping, Optional, Sequence, Union

import numpy as np

from ..errors import Busy, Disconnected, Late, Noted, ShuttingDown, Superseded, Timeout, Unsupported, UsageError, VlaError
from ..observation import Leftover, is_pillow
from .blend import Blend, CrossFade, Ensemble
from .limits import Limiter, Limits
from .schedule import Action, ChunkSchedule, OnLate, late_rule

Observation = Union[Mapping[str, Any], Callable[[], Mapping[str, Any]]]

# Errors after which another observation may succeed. All other errors would recur, and are raised.
PASSING = (Busy, Disconnected, Late, ShuttingDown, Superseded, Timeout)
ACT_DECAY = 0.01
LOG = logging.getLogger("vla_cpp.control")


@dataclass(frozen=True)
class RealTimeChunking:
    """How a chunk continues the previous one, in the mode "rtc".

    overlap       most rows of the newest chunk that are sent with an observation; only rows that are not commanded yet are sent
    schedule      only for a guided policy: `schedule` of `vla_cpp.Leftover`
    max_guidance  only for a guided policy: `max_guidance` of `vla_cpp.Leftover`
    """

    overlap: int
    schedule: Optional[str] = None
    max_guidance: Optional[float] = None


class ChunkLoop:
    """Turns observations into one action per control period, with a policy that answers in chunks.

        loop = ChunkLoop(policy, rate_hz=20, replan_every=8, mode="async", blend="ensemble", on_late="hold",
                         on_note="warn")
        while running:
            action = loop.step(lambda: dict(images=cameras(), state=joints(), text="open the drawer"))
            if action.values is not None:
                command(action.values)
            loop.pace()

    policy        vla_cpp.Client, vla_cpp.Policy, or anything with their `spec` and `act`
    rate_hz       control periods per second; must equal the training rate if the bundle states it, unless allow_other_rate is set.
                  None: the rate in the bundle
    replan_every  rows of a chunk that are commanded before the next observation is taken. None: the checkpoint's n_action_steps, if the
                  bundle states it. A value taken from the bundle, or differing from it, is logged in "vla_cpp.control"
    mode          "sync": `step` waits for the chunk; the robot stands still meanwhile. "async": the chunk is computed while rows of the
                  previous chunk are commanded; its rows whose steps have passed on arrival are skipped. "rtc": as "async", and the policy
                  continues the rows of the previous chunk that are not commanded yet
    blend         "replace"; "linear", over `fade_steps` steps; "ensemble", with `decay`; or a Blend
    rtc           RealTimeChunking, for the mode "rtc"
    on_late       what to command when no chunk has a row: "hold" repeats the last command, which is right for positions and WRONG
                  for velocities and differences; "zero" commands zeros; "stop" raises Late; a function (last command or None, tick)
                  returns the values, or None to command nothing. When a chunk arrives, commands continue with its row for that step
    on_note       what to do with a chunk that has notes, e.g. of a state far from the training data: "ignore" the notes, "warn" of each
                  (Python's warnings), or "raise" Noted instead of commanding the chunk. `stats` counts the notes
    max_age       most seconds from an observation to a command based on it. Default: in "async" mode the duration of a chunk's rows; in
                  "sync" mode, where the robot stands still during inference, no limit
    limits        Limits, or the path of a limits file (docs/control.md): every command is kept within them. Call `start_at` first. A chunk
                  that breaks them in too many rows raises BadAction. None: only the robot's own controller can refuse commands
    max_jump      largest change of each value from one command to the next; a larger change is cut. A number, or one per value
    clock, sleep  functions that return the time in seconds and that wait for seconds; default time.monotonic and time.sleep

    Only one thread may use a loop. Call `step` once in each control period. Transient errors of the policy (Busy, Disconnected, Late,
    ShuttingDown, Superseded, Timeout) are counted in `stats`; the next period retries, and `on_late` supplies commands meanwhile.
    `last_error` is the error of the newest inference, or None. `step` raises all other errors.
    """

    def __init__(
        self,
        policy: Any,
        *,
        rate_hz: Optional[float] = None,
        replan_every: Optional[int] = None,
        mode: str,
        blend: Union[str, Blend],
        on_late: Union[str, OnLate],
        on_note: str,
        fade_steps: Optional[int] = None,
        decay: float = ACT_DECAY,
        rtc: Optional[RealTimeChunking] = None,
        max_age: Optional[float] = None,
        max_jump: Union[float, np.ndarray, None] = None,
        limits: Union[Limits, str, Path, None] = None,
        allow_other_rate: bool = False,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        if mode not in ("sync", "async", "rtc"):
            raise UsageError("mode", '"sync", "async" or "rtc"', repr(mode))
        if (mode == "rtc") != isinstance(rtc, RealTimeChunking):
            raise UsageError("rtc", 'a RealTimeChunking with the mode "rtc", and only there', repr(rtc))
        if on_note not in ("ignore", "warn", "raise"):
            raise UsageError("on_note", '"ignore", "warn" or "raise"', repr(on_note))
        spec = policy.spec
        rate_hz = _stated("rate_hz", rate_hz, spec.rate_hz, spec.bundle.name)
        replan_every = _stated("replan_every", replan_every, getattr(spec, "n_action_steps", 0), spec.bundle.name)
        if not 0 < rate_hz < math.inf:
            raise UsageError("rate_hz", "periods per second, above 0", str(rate_hz))
        if spec.rate_hz > 0 and abs(spec.rate_hz - rate_hz) > 1e-6 * rate_hz and not allow_other_rate:
            hint = "a robot at another rate moves at another speed; allow_other_rate=True if that is meant"
            raise UsageError("rate_hz", f"{spec.rate_hz:g}, that of {spec.bundle.name}", f"{rate_hz:g}", hint)
        if rtc and not spec.real_time_chunking:
            raise Unsupported("mode", "a policy that goes on from rows of the chunk before", spec.bundle.name)
        if rtc and not 1 <= rtc.overlap <= spec.horizon:
            raise UsageError("rtc.overlap", f"1 to {spec.horizon}, the rows of a chunk", str(rtc.overlap))
        if isinstance(limits, (str, Path)):
            limits = Limits.read(limits)
        self._limiter = Limiter(limits.of(spec), rate_hz) if limits else None
        self.schedule = ChunkSchedule(
            horizon=spec.horizon,
            d_action=spec.d_action,
            replan_every=replan_every,
            blend=_blend_of(blend, fade_steps, decay),
            on_late=late_rule(on_late, spec.d_action, self._limiter),
            max_age=_age_in_ticks(max_age, rate_hz, None if mode == "sync" else spec.horizon),
            max_jump=max_jump,
            limiter=self._limiter,
        )
        self.rate_hz, self.mode, self.rtc, self.on_note = rate_hz, mode, rtc, on_note
        self._policy, self._clock, self._sleep = policy, clock, sleep
        # A client has `submit`, which does not wait; any other policy runs in a worker thread.
        self._worker = None if hasattr(policy, "submit") else ThreadPoolExecutor(1, "vla-act")
        self._handle: Any = None
        self._forget()

    def _forget(self) -> None:
        self.driver: Optional[str] = None  # name of the person who drives
        self._start: Optional[float] = None
        self._tick = -1
        self._missed = self._notes = 0
        self._errors: Dict[str, int] = {}
        self.last_error: Optional[VlaError] = None

    def start_at(self, values: Any) -> None:
        """States the values at which the robot rests now, one number for each action: `limits` apply from there. Repeat after `reset`.

        Errors: UsageError without limits, or for a position outside its limits.
        """
        if not self._limiter:
            raise UsageError("start_at", "a loop with limits", "none")
        self._limiter.rest_at(values)

    def take_over(self, who: str) -> None:
        """Lets a person drive: `step` then commands its argument `human`. The policy keeps computing, and `Action.policy` is its command.
        Errors: UsageError if another person drives."""
        if self.driver is not None:
            raise UsageError("take_over", "nobody who drives", self.driver)
        self.driver = who

    def give_back(self, who: str) -> None:
        """Lets the policy drive again, with chunks from new observations: earlier chunks are dropped. Commands continue from the person's
        last one by the rules of `on_late` and `blend`. Errors: UsageError if `who` does not drive."""
        if self.driver != who:
            raise UsageError("give_back", f"{who}, who drives", str(self.driver or "nobody"))
        self.driver = None
        self._handle = None
        self.schedule.forget_chunks()

    def step(self, observation: Observation, human: Any = None) -> Action:
        """One control period.

        observation  the arguments of `policy.act`, or a function that returns them. The function is called only when an observation is
                     needed, so that cameras are not read in other periods
        human        the driving person's command, one number for each action; it is kept within the limits. If None while a person drives,
                     `on_late` supplies the command
        """
        if human is not None and self.driver is None:
            raise UsageError("human", "a person who drives: take_over", "nobody")
        tick = self._now()
        self._collect(tick)
        if self.schedule.wants(tick):
            self._submit(observation, tick)
            if self.mode == "sync":
                self._wait()
                tick = self._now()
                self._collect(tick)
        self._missed += tick - self._tick - 1
        self._tick = tick
        if self.driver is not None and human is None:
            return self.schedule.hold(tick)
        return self.schedule.next(tick, human)

    def begin(self, observation: Observation) -> None:
        """Waits for a first chunk, so that the first `step` has an action. Errors: those of `policy.act`."""
        tick = self._now()
        if self.schedule.wants(tick):
            self._submit(observation, tick)
        self._wait()
        self._start = None
        self._collect(self._now())
        if self.last_error:
            raise self.last_error

    def pace(self) -> None:
        """Waits until the next control period begins."""
        if self._start is not None:
            self._sleep(max(0.0, self._start + (self._tick + 1) / self.rate_hz - self._clock()))

    @property
    def stats(self) -> Dict[str, Any]:
        """Counts since the start: actions (commanded by the policy), held, chunks, stale (chunks dropped for their age), failed (in total,
        and per error code), limited, refused, human (commanded by a person), missed (periods without a call of `step`), notes; and the
        delay in steps."""
        own = {"missed": self._missed, "notes": self._notes, "delay": self.schedule.delay}
        return {**self.schedule.counts, **self._errors, **own}

    def reset(self) -> None:
        """Begins a new episode. The result of a running inference is dropped."""
        self._handle = None
        self._forget()
        self.schedule.reset()

    def close(self) -> None:
        """Ends the loop's thread; the policy stays open."""
        self._handle = None
        if self._worker:
            self._worker.shutdown(wait=False)

    def __enter__(self) -> ChunkLoop:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # --- inside ----------------------------------------------------------------------------------------------------------------

    def _now(self) -> int:
        """The current control period, always later than the last one: an early call counts for the next period, a late call misses some."""
        now = self._clock()
        if self._start is None:
            self._start = now - (self._tick + 1) / self.rate_hz
        return max(self._tick + 1, math.floor((now - self._start) * self.rate_hz + 0.5))

    def _submit(self, observation: Observation, tick: int) -> None:
        arguments = observation() if callable(observation) else observation
        rows = self.schedule.leftover(self.rtc.overlap) if self.rtc else None
        if rows is not None:
            delay = min(self.schedule.delay or 0, len(rows))
            arguments = {**arguments, "leftover": Leftover(rows, delay, self.rtc.schedule, self.rtc.max_guidance)}
        self.schedule.observe(tick)
        try:
            if self._worker:
                self._handle = self._worker.submit(self._policy.act, **_snapshot(arguments))
            else:
                told = {"loop": self._state()} if "loop" in getattr(self._policy, "features", ()) else {}
                self._handle = self._policy.submit(**arguments, **told)
        except VlaError as error:
            self._fail(error)

    def _state(self) -> Dict[str, Any]:
        """The state of the loop for the server's page: the fields of a LoopState (src/wire/vla.proto)."""
        stats = self.stats
        counts = {name: stats[name] for name in ("actions", "human", "held", "missed", "limited", "refused")}
        return {"driver": "POLICY" if self.driver is None else "PERSON", **counts}

    def _wait(self) -> None:
        if self._handle is not None:
            try:
                self._handle.result()
            except VlaError:
                pass  # `_collect` handles the error, as in the other modes

    def _collect(self, tick: int) -> None:
        if self._handle is None or not self._handle.done():
            return
        handle, self._handle = self._handle, None
        try:
            chunk = handle.result()
        except VlaError as error:
            self._fail(error)
        except BaseException:
            self.schedule.fail()
            raise
        else:
            self.last_error = None
            self._hear(chunk.notes)
            self.schedule.receive(chunk, tick)

    def _hear(self, notes: Sequence[str]) -> None:
        self._notes += len(notes)
        if notes and self.on_note == "raise":
            self._fail(Noted("chunk", "no notes", "; ".join(notes)))
        for note in notes if self.on_note == "warn" else ():
            warnings.warn(note, stacklevel=4)

    def _fail(self, error: VlaError) -> None:
        self.schedule.fail()
        self._errors[error.code] = self._errors.get(error.code, 0) + 1
        self.last_error = error
        if not isinstance(error, PASSING):
            raise error


def _stated(name: str, given: Any, stated: float, bundle: str) -> Any:
    """The caller's value, or else the bundle's. Logs a value from the bundle, and a difference. Errors: UsageError if neither has one."""
    if given is None:
        if not stated > 0:
            raise UsageError(name, "a number, since the bundle does not say", "none")
        LOG.warning("%s=%g, as %s says", name, stated, bundle)
        return stated
    if stated > 0 and given != stated:
        LOG.warning("%s=%g, where %s says %g", name, given, bundle, stated)
    return given


def _snapshot(value: Any) -> Any:
    """Copies arrays: a camera may write its next frame while another thread still reads this one."""
    if isinstance(value, Mapping):
        return {key: _snapshot(part) for key, part in value.items()}
    return value.copy() if isinstance(value, np.ndarray) or is_pillow(value) else value


def _blend_of(blend: Union[str, Blend], fade_steps: Optional[int], decay: float) -> Blend:
    if isinstance(blend, Blend):
        return blend
    if blend == "replace":
        return CrossFade(0)
    if blend == "ensemble":
        return Ensemble(decay)
    if blend != "linear":
        raise UsageError("blend", '"replace", "linear", "ensemble" or a Blend', repr(blend))
    if fade_steps is None:
        raise UsageError(
            "fade_steps", "the steps of the cross-fade", "none", "half of replan_every is a place to begin"
        )
    return CrossFade(fade_steps)


def _age_in_ticks(seconds: Optional[float], rate_hz: float, default: Optional[int]) -> Optional[int]:
    if seconds is None:
        return default
    if not seconds >= 0:
        raise UsageError("max_age", "seconds, 0 or more", str(seconds))
    return math.floor(seconds * rate_hz + 1e-9)

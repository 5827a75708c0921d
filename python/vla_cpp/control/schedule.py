# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The rules of a control loop as a state machine: no clock, no thread, no socket. The same calls give the same actions.

Two counters: a *tick* is a control period; a *step* is a row that was commanded. Rows are counted
in steps. So the delay of an inference is the number of rows that were commanded while it ran; a robot that held still meanwhile has
not moved on, and misses no row; and the wait for the very first chunk is no delay at all. Age is counted in ticks.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any, Callable, Deque, Dict, List, NamedTuple, Optional, Tuple, Union

import numpy as np

from ..errors import BadAction, Late, UsageError
from .blend import Blend, Source
from .limits import Limiter, finite_row

OnLate = Callable[[Optional[np.ndarray], int], Optional[np.ndarray]]
N_DELAY = 16  # inferences that an estimate of the delay looks back on


@dataclass(frozen=True, eq=False)
class Action:
    """What to command in one control period.

    values   float32 (d_action,) in world units; None: command nothing (before the first chunk)
    tick     the control period
    held     no chunk had a row for it: the values are what `on_late` says
    age      control periods since the oldest observation that contributes; None where held
    sources  (tick of the observation, weight) of what contributes; the tick is None for the held command in a fade
    chunk    the newest contributing chunk, as it was received; None where held
    limited  `max_jump` or a limit cut it
    clamped  the columns that a limit cut
    human    a person commanded it (`take_over`)
    policy   what the policy wanted then, before any limit; None where no chunk had a row
    """

    values: Optional[np.ndarray]
    tick: int
    held: bool
    age: Optional[int] = None
    sources: Tuple[Tuple[Optional[int], float], ...] = ()
    chunk: Any = None
    limited: bool = False
    clamped: Tuple[int, ...] = ()
    human: bool = False
    policy: Optional[np.ndarray] = None


class Flight(NamedTuple):
    """An observation whose chunk has not come yet."""

    step: int
    tick: int
    is_warm: bool  # there was something to command when it was taken


class ChunkSchedule:
    """In each control period: `wants`, and then perhaps `observe`; `receive` or `fail` when the answer is there; `next`, once.

    horizon, d_action  shape of the chunks
    replan_every       steps from one observation to the next
    blend              how chunks share a command where they overlap
    on_late            (last command or None, tick) -> what to command when there is no row
    max_age            control periods after its observation in which a row may be commanded; None: as long as there are rows
    max_jump           largest change of each value from one command to the next: a number, or (d_action,); None: any.
                       What `on_late` says is not limited: a stop must be able to be sudden
    limiter            keeps every command within limits, those of `on_late` too: then a stop is as fast as they permit
    """

    def __init__(
        self,
        *,
        horizon: int,
        d_action: int,
        replan_every: int,
        blend: Blend,
        on_late: OnLate,
        max_age: Optional[int] = None,
        max_jump: Union[float, np.ndarray, None] = None,
        limiter: Optional[Limiter] = None,
    ) -> None:
        if limiter is not None and max_jump is not None:
            raise UsageError("max_jump", "none beside limits, which say how far a command may jump", str(max_jump))
        if not 1 <= replan_every <= horizon:
            raise UsageError("replan_every", f"1 to {horizon}, the rows of a chunk", str(replan_every))
        if max_age is not None and max_age < 0:
            raise UsageError("max_age", "0 or more", str(max_age))
        self.horizon, self.d_action, self.replan_every = horizon, d_action, replan_every
        self._blend, self._on_late, self._max_age = blend, on_late, max_age
        self._max_jump = _limits(max_jump, d_action)
        self._limiter = limiter
        self.reset()

    def reset(self) -> None:
        """Forgets everything, as before the first call: an episode begins."""
        self.step = 0
        counts = ("actions", "held", "chunks", "stale", "failed", "limited", "refused", "human")
        self.counts: Dict[str, int] = dict.fromkeys(counts, 0)
        if self._limiter:
            self._limiter.reset()
        self._sources: List[Source] = []
        self._flight: Optional[Flight] = None
        self._last: Optional[np.ndarray] = None  # the last command
        self._tick = -1
        self._end: Optional[Exception] = None
        self._delays: Deque[int] = deque(maxlen=N_DELAY)

    @property
    def delay(self) -> Optional[int]:
        """Steps that the slowest of the last inferences took; None before one that began while there was something to command."""
        return max(self._delays, default=None)

    def leftover(self, n_row: int) -> Optional[np.ndarray]:
        """The next rows of the newest chunk, at most `n_row`, as its network answered them; None where it has none."""
        newest = self._sources[-1] if self._sources else None
        if newest is None or newest.chunk is None:
            return None
        first = self.step - newest.step
        rows = newest.chunk.normalized[first : first + n_row]
        return rows if len(rows) else None

    def wants(self, tick: int) -> bool:
        """Whether an observation should be taken now: none is under way, and the newest chunk has been executed for S steps, or there is none."""
        self._begin(tick)
        if self._flight is not None:
            return False
        return not self._sources or self.step - self._sources[-1].step >= self.replan_every

    def observe(self, tick: int) -> None:
        """An observation was taken and is on its way."""
        self._begin(tick)
        if self._flight is not None:
            raise UsageError("observe", "one observation at a time", "a second one")
        self._flight = Flight(self.step, tick, bool(self._sources))

    def fail(self) -> None:
        """The observation under way will have no chunk."""
        self._flight = None
        self.counts["failed"] += 1

    def receive(self, chunk: Any, tick: int) -> bool:
        """The chunk for the observation under way. False: it came too late to be of use, and was dropped.

        Errors: BadAction for a chunk of another shape, or with a number that is not finite, or too many of whose rows break a limit;
        nothing of it is used.
        """
        self._begin(tick)
        flight, self._flight = self._flight, None
        if flight is None:
            raise UsageError("receive", "a chunk for an observation under way", "one that nobody asked for")
        rows = np.array(chunk, np.float32)
        if rows.shape != (self.horizon, self.d_action) or not np.isfinite(rows).all():
            found = f"shape {rows.shape}" if rows.shape != (self.horizon, self.d_action) else "one that is not"
            raise BadAction("chunk", f"({self.horizon}, {self.d_action}) finite numbers", found)
        if self._limiter:
            self._check_limits(rows)
        if flight.is_warm:
            self._delays.append(self.step - flight.step)
        self.counts["chunks"] += 1
        if not self._is_admissible(flight.step, flight.tick, self.horizon, tick):
            self.counts["stale"] += 1
            return False
        fade = self._make_fade(tick)
        self._sources.append(Source(flight.step, flight.tick, rows, self.step, fade, chunk))
        return True

    def next(self, tick: int, human: Any = None) -> Action:
        """What to command in this control period, which ends with it: the next tick must be a later one.

        human  what a person commands instead, one number for each action. Limits hold for it too

        Errors: what `on_late` raises, then and from then on: a loop that was stopped goes on after `reset` only. BadAction for a
        command of a person that is not finite.
        """
        self._begin(tick)
        if self._end:
            raise self._end
        if human is not None:
            human = finite_row("human", human, self.d_action).astype(np.float32)
        self._tick = tick
        if human is None and not self._sources:
            return self._hold(tick)
        weights = self._blend.weights(self._sources, self.step) if self._sources else ()
        parts = [(w, s) for w, s in zip(weights, self._sources) if w > 0]
        wanted = self._mix(parts) if parts else None
        is_human = human is not None
        values, limited, clamped = self._limit(human if is_human else wanted, is_human)
        self._last = values
        self.step += 1
        self.counts["human" if is_human else "actions"] += 1
        self.counts["limited"] += limited
        ages = [tick - s.tick for _, s in parts if s.tick is not None]
        sources = tuple((s.tick, float(w)) for w, s in parts)
        chunk = parts[-1][1].chunk if parts else None
        return Action(values.copy(), tick, False, max(ages, default=None), sources, chunk, limited, clamped, is_human, wanted if is_human else None)

    def hold(self, tick: int) -> Action:
        """As `next` where no chunk has a row."""
        self._begin(tick)
        if self._end:
            raise self._end
        self._tick = tick
        return self._hold(tick)

    def forget_chunks(self) -> None:
        """Chunks, and the observation under way, are not used any more. The last command stays, and what comes next fades from it."""
        self._sources, self._flight = [], None

    # --- inside ----------------------------------------------------------------------------------------------------------------

    def _mix(self, parts: List[Tuple[float, Source]]) -> np.ndarray:
        """The weighted sum of the sources' rows for this step; of a gripper the newest one's value, since half of two decisions is none."""
        row = sum(w * s.row(self.step).astype(np.float64) for w, s in parts).astype(np.float32)
        return np.where(self._limiter.is_gripper, parts[-1][1].row(self.step), row) if self._limiter else row

    def _begin(self, tick: int) -> None:
        if tick <= self._tick:
            raise UsageError("tick", f"later than {self._tick}, which had its action", str(tick))
        self._sources = [s for s in self._sources if self._is_admissible(s.step, s.tick, len(s.rows), tick)]
        if all(s.tick is None for s in self._sources):  # a held command only fades; it is nothing to go on with
            self._sources = []

    def _is_admissible(self, step: int, observed: Optional[int], n_row: int, tick: int) -> bool:
        is_fresh = self._max_age is None or observed is None or tick - observed <= self._max_age
        return is_fresh and self.step < step + n_row

    def _make_fade(self, tick: int) -> int:
        """Steps of a fade that begins now: not more than what fades out has left. After a hold, that is the held command."""
        fade = self._blend.fade_steps
        if self._sources:
            newest = self._sources[-1]
            fade = min(fade, newest.rows_left(self.step))
            if self._max_age is not None and newest.tick is not None:
                fade = min(fade, newest.tick + self._max_age - tick + 1)
        elif self._last is None:
            return 0
        elif fade:
            self._sources = [Source(self.step, None, np.tile(self._last, (fade, 1)), self.step, 0)]
        return fade

    def _hold(self, tick: int) -> Action:
        self.counts["held"] += 1
        values = self._late_values(tick)
        if values is not None:
            clamped: Tuple[int, ...] = ()
            if self._limiter:
                values, _, clamped = self._limit(values)
            self._last = values
            return Action(values.copy(), tick, True, limited=bool(clamped), clamped=clamped)
        return Action(None, tick, True)

    def _late_values(self, tick: int) -> Optional[np.ndarray]:
        try:
            values = self._on_late(None if self._last is None else self._last.copy(), tick)
            if values is None:
                return None
            values = np.array(values, np.float32)
            if values.shape != (self.d_action,) or not np.isfinite(values).all():
                raise BadAction("on_late", f"{self.d_action} finite numbers", str(values))
            return values
        except Exception as error:
            self._end = error
            raise

    def _limit(self, values: np.ndarray, is_human: bool = False) -> Tuple[np.ndarray, bool, Tuple[int, ...]]:
        if self._limiter:
            values, is_cut = self._limiter.step(values)
            return values, bool(is_cut.any()), tuple(int(i) for i in np.flatnonzero(is_cut))
        if self._max_jump is None or self._last is None or is_human:
            return values, False, ()
        cut = np.clip(values, self._last - self._max_jump, self._last + self._max_jump)
        return cut, bool((cut != values).any()), ()

    def _check_limits(self, rows: np.ndarray) -> None:
        broken = self._limiter.breaks(rows)
        most = self._limiter.limits.refuse_above
        if broken.mean() > most:
            self.counts["refused"] += 1
            found = f"{int(broken.sum())} of {len(rows)}, the first of them row {int(np.argmax(broken))}"
            hint = "statistics, units or the order of columns may be another robot's"
            raise BadAction("chunk", f"at most a share of {most:g} of its rows outside of the limits", found, hint)


def late_rule(on_late: Union[str, OnLate], d_action: int, limiter: Optional[Limiter] = None) -> OnLate:
    """`on_late` of ChunkLoop as a function. "zero" leaves grippers, of which limits tell, as they are."""
    if callable(on_late):
        return on_late
    if on_late == "hold":
        return lambda last, tick: last
    if on_late == "zero" and limiter:
        return lambda last, tick: limiter.still()
    if on_late == "zero":
        return lambda last, tick: np.zeros(d_action, np.float32)
    if on_late == "stop":
        return _stop
    raise UsageError("on_late", '"hold", "zero", "stop" or a function', repr(on_late))


def _stop(last: Optional[np.ndarray], tick: int) -> None:
    if last is not None:
        raise Late("control", f"an action for period {tick}", "no chunk that has one", "stop the robot; then reset()")


def _limits(max_jump: Union[float, np.ndarray, None], d_action: int) -> Optional[np.ndarray]:
    if max_jump is None:
        return None
    limits = np.array(max_jump, np.float32)
    if limits.shape not in ((), (d_action,)) or not (limits > 0).all():
        raise UsageError("max_jump", f"a number above 0, or {d_action} of them", str(max_jump))
    return limits

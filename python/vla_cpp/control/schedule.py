# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The rules of a control loop as a state machine: no clock, no thread, no socket. The same calls give the same actions.

There are two counters: ticks count control periods, steps count commanded rows. The delay of an inference is the number of steps while
it runs. So a robot that holds still meanwhile skips no row, and the wait for the very first chunk is not a delay. Age is counted in ticks.
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
N_DELAY = 16  # number of latest inferences from which the delay is estimated


@dataclass(frozen=True, eq=False)
class Action:
    """The command of one control period.

    values   float32 (d_action,) in world units; None: command nothing (`on_late` returned None, e.g. before the first chunk)
    tick     number of the control period
    held     True: no chunk had a row for the step, so the values come from `on_late`
    age      control periods since the oldest contributing observation; None if held
    sources  (tick of the observation, weight) of each contributing source; the tick is None for the held command in a fade
    chunk    the newest contributing chunk, as received; None if held
    limited  True: `max_jump` or a limit changed the command
    clamped  the columns that a limit changed
    human    True: a person's command (`take_over`)
    policy   if human: the policy's command, before any limit; None if no chunk had a row
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
    """An observation whose chunk has not arrived yet."""

    step: int
    tick: int
    is_warm: bool  # a chunk had rows to command when the observation was taken


class ChunkSchedule:
    """Calls in each control period: `wants`, and if it returns True `observe`; `receive` or `fail` when the answer arrives; `next`, once.

    horizon, d_action  shape of the chunks
    replan_every       steps from one observation to the next
    blend              weights of overlapping chunks
    on_late            (last command or None, tick) -> the command when no chunk has a row
    max_age            most control periods from an observation to a command with its rows; None: no limit
    max_jump           largest change of each value from one command to the next: a number, or (d_action,); None: no limit.
                       Commands of `on_late` are not limited by it, so that a stop can be sudden
    limiter            keeps every command within limits, also those of `on_late`: a stop is then as fast as the limits permit
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
        """Begins an episode: resets everything to the state before the first call."""
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
        """Delay in steps of the slowest of the last N_DELAY inferences. Only inferences that began with rows to command count; None
        before the first."""
        return max(self._delays, default=None)

    def leftover(self, n_row: int) -> Optional[np.ndarray]:
        """The next rows of the newest chunk, at most `n_row`, as its network computed them (`normalized`); None if there are none."""
        newest = self._sources[-1] if self._sources else None
        if newest is None or newest.chunk is None:
            return None
        first = self.step - newest.step
        rows = newest.chunk.normalized[first : first + n_row]
        return rows if len(rows) else None

    def wants(self, tick: int) -> bool:
        """Whether to take an observation now: none is pending, and the newest chunk was observed `replan_every` steps ago, or there is none."""
        self._begin(tick)
        if self._flight is not None:
            return False
        return not self._sources or self.step - self._sources[-1].step >= self.replan_every

    def observe(self, tick: int) -> None:
        """Records that an observation was taken and sent."""
        self._begin(tick)
        if self._flight is not None:
            raise UsageError("observe", "one observation at a time", "a second one")
        self._flight = Flight(self.step, tick, bool(self._sources))

    def fail(self) -> None:
        """Records that the pending observation will have no chunk."""
        self._flight = None
        self.counts["failed"] += 1

    def receive(self, chunk: Any, tick: int) -> bool:
        """Adds the chunk of the pending observation. Returns False if it was too late and is dropped.

        Errors: BadAction for a chunk of another shape, with a number that is not finite, or with too many rows that break a limit;
        the whole chunk is then dropped.
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
        """The command of this control period. Ends the period: the next call needs a later tick.

        human  a person's command, used instead of the policy's, one number for each action. It is kept within the limits too

        Errors: those of `on_late`; every later call raises the same error until `reset`. BadAction for a command of a person that is not
        finite.
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
        """The command of `on_late` for this control period, as `next` gives it if no chunk has a row."""
        self._begin(tick)
        if self._end:
            raise self._end
        self._tick = tick
        return self._hold(tick)

    def forget_chunks(self) -> None:
        """Drops all chunks and the pending observation. Keeps the last command, from which the next chunk fades in."""
        self._sources, self._flight = [], None

    # --- inside ----------------------------------------------------------------------------------------------------------------

    def _mix(self, parts: List[Tuple[float, Source]]) -> np.ndarray:
        """The weighted sum of the sources' rows for this step; a gripper has the newest source's value, since the mean of two open/close
        decisions is not a decision."""
        row = sum(w * s.row(self.step).astype(np.float64) for w, s in parts).astype(np.float32)
        return np.where(self._limiter.is_gripper, parts[-1][1].row(self.step), row) if self._limiter else row

    def _begin(self, tick: int) -> None:
        if tick <= self._tick:
            raise UsageError("tick", f"later than {self._tick}, which had its action", str(tick))
        self._sources = [s for s in self._sources if self._is_admissible(s.step, s.tick, len(s.rows), tick)]
        if all(s.tick is None for s in self._sources):  # a held command only fades out; alone it is no source
            self._sources = []

    def _is_admissible(self, step: int, observed: Optional[int], n_row: int, tick: int) -> bool:
        is_fresh = self._max_age is None or observed is None or tick - observed <= self._max_age
        return is_fresh and self.step < step + n_row

    def _make_fade(self, tick: int) -> int:
        """Number of steps of a fade that begins now: at most the rows that the newest source has left. After a hold, the last command is
        added as a source and fades out."""
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
    """`on_late` of ChunkLoop as a function. "zero" keeps the last command of columns that the limits declare as grippers."""
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

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Limits of commands: range, velocity, acceleration and jerk of each action column.

A `Limiter` leaves a command within all limits unchanged and changes any other as little as possible. It keeps this invariant: **from the
last command there is a stop within all limits**, that is, a list of accelerations after which the column rests.

* Before the first command the column rests, and the stop is empty.
* A command is used unchanged if it is within the limits and a stop from it is found (`_stops`).
* Otherwise the limiter uses a command between the wanted one and the next command of the stored stop: by bisection the nearest to the
  wanted one from which a stop is found. In the worst case it is the next command of the stored stop, whose remainder is the new stop.

So, by induction, every command is within every limit, and after a changed command there is always a permitted next one. A command depends
only on its own row and on earlier commands. Numbers are double; each command is rounded to float32 once, so a difference of two commands
may be off by that rounding.
"""

from __future__ import annotations

import json
import math
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Dict, List, Mapping, NamedTuple, Optional, Sequence, Tuple, Union

import numpy as np

from ..errors import BadAction, UsageError
from ..output import write_text
from ..spec import Spec
from ..strict_json import no_constant, unique_names

FORMAT = "vla-limits 1"
KINDS = ("position", "velocity", "difference", "gripper")
N_HALF = 16  # most bisection steps of the search for a permitted command
MAX_STOP = 4096  # most steps of a stop
MAX_FILE = 1 << 20  # bytes
FAR = 1e9  # stands for a limit that is not given
SLACK = 1e-9  # tolerance for rounding in double, relative to the limit
ROUNDING = 1e-12  # relative rounding error of a product in double; far below SLACK


@dataclass(frozen=True)
class Column:
    """The limits of an action column, in the column's unit and seconds. None: not limited.

    kind          "position": the value is a position. "velocity": units per second. "difference": units per control period.
                  "gripper": an opening or an open/close decision, which may jump and is never blended: it has only a range
    unit          as the bundle states it; else empty
    low, high     range of the value itself
    velocity      largest speed, in units per second: for a position the change between commands, for other kinds the value itself
    acceleration  largest change of the velocity per second
    jerk          largest change of the acceleration per second
    """

    name: str
    kind: str
    unit: str = ""
    low: Optional[float] = None
    high: Optional[float] = None
    velocity: Optional[float] = None
    acceleration: Optional[float] = None
    jerk: Optional[float] = None


@dataclass(frozen=True)
class Limits:
    """Limits of all columns of an action, and the share of a chunk's rows that may break them before the chunk is refused.

    Errors: UsageError, naming the column, for what is missing, unknown, not a number, or impossible together.
    """

    columns: Tuple[Column, ...]
    refuse_above: float

    def __post_init__(self) -> None:
        for column in self.columns:
            _check(column)
        if len({c.name for c in self.columns}) < len(self.columns):
            raise UsageError("limits", "each column once", "one twice")
        if not 0 <= self.refuse_above <= 1:
            raise UsageError("limits.refuse_above", "a share of rows, 0 to 1", str(self.refuse_above))

    @staticmethod
    def read(path: Union[str, Path]) -> Limits:
        """Reads a file of limits, made by `write` or by hand (docs/control.md). Errors: UsageError."""
        try:
            if not os.path.isfile(path) or os.path.getsize(path) > MAX_FILE:
                raise ValueError(f"no regular file of at most {MAX_FILE} bytes")
            text = Path(path).read_text("utf-8")
            return Limits.parse(json.loads(text, parse_constant=no_constant, object_pairs_hook=unique_names))
        except (OSError, ValueError, RecursionError) as error:
            raise UsageError(str(path), "a file of limits in JSON", str(error)) from None

    @staticmethod
    def parse(document: Any) -> Limits:
        fields = {"format", "columns", "refuse_above"}
        if not isinstance(document, dict) or set(document) != fields or document["format"] != FORMAT:
            raise UsageError("limits", f'an object with {", ".join(sorted(fields))}, of format "{FORMAT}"', str(document)[:80])
        if not isinstance(document["columns"], dict) or not document["columns"]:
            raise UsageError("limits.columns", "an object with each action's name", str(document["columns"])[:80])
        columns = tuple(_parse_column(name, given) for name, given in document["columns"].items())
        return Limits(columns, _number("limits.refuse_above", document["refuse_above"]))

    def write(self, path: Union[str, Path]) -> None:
        columns = {c.name: _document(c) for c in self.columns}
        document = {"format": FORMAT, "columns": columns, "refuse_above": self.refuse_above}
        write_text(path, json.dumps(document, indent=2) + "\n")

    @staticmethod
    def suggest(
        spec: Spec, kinds: Mapping[str, str], commands: np.ndarray, rate_hz: float, *, margin: float, refuse_above: float
    ) -> Limits:
        """Initial limits from recorded commands of a robot: the largest of each quantity, times `margin`.

        kinds     "position", "velocity", "difference" or "gripper" of each action
        commands  (n, d_action), at least four consecutive commands at `rate_hz`
        margin    1 or more; a range is widened around its middle to `margin` times its width. The range of a gripper keeps its width: its
                  ends mean open and closed
        """
        rows = np.asarray(commands, np.float64)
        if rows.ndim != 2 or rows.shape[1] != spec.d_action or len(rows) < 4 or not np.isfinite(rows).all():
            raise UsageError("commands", f"(4 or more, {spec.d_action}) finite numbers", f"shape {rows.shape}")
        if not 1 <= margin < math.inf or not 0 < rate_hz < math.inf:
            raise UsageError("margin, rate_hz", "1 or more, and above 0", f"{margin}, {rate_hz}")
        _check_names(kinds, spec)
        columns = []
        for i, name in enumerate(spec.action_names):
            low, high = rows[:, i].min(), rows[:, i].max()
            grown = (margin - 1) / 2 * (high - low)
            scale = _scale(kinds[name], rate_hz)
            place = rows[:, i] if kinds[name] == "position" else np.cumsum(rows[:, i])
            most = [margin * float(np.abs(np.diff(place, n)).max()) / s or None for n, s in zip((1, 2, 3), scale)]
            unit = spec.action_units[i] if spec.action_units else ""
            if kinds[name] == "gripper":
                columns.append(gripper(name, unit, float(low), float(high)))
            else:
                columns.append(Column(name, kinds[name], unit, float(low - grown), float(high + grown), *most))
        return Limits(tuple(columns), refuse_above)

    def of(self, spec: Spec) -> Limits:
        """These limits in the order of the policy's columns. Errors: UsageError if names or units differ from the bundle's."""
        given = {c.name: c for c in self.columns}
        _check_names(given, spec)
        for name, unit in zip(spec.action_names, spec.action_units or [""] * spec.d_action):
            if unit and given[name].unit != unit:
                raise UsageError(f"limits.{name}.unit", f'"{unit}", as {spec.bundle.name} says', f'"{given[name].unit}"')
        return Limits(tuple(given[name] for name in spec.action_names), self.refuse_above)


class Stops(NamedTuple):
    """A stop of each column. steps: accelerations [steps, columns], zeros after the column's last step; found: whether a stop exists."""

    found: np.ndarray
    steps: np.ndarray


class Limiter:
    """Keeps the commands of one robot within limits. Call `step` once for each control period, in order.

    limits   in the order of the columns (`Limits.of`)
    rate_hz  commands per second
    """

    def __init__(self, limits: Limits, rate_hz: float) -> None:
        self.limits = limits
        columns = limits.columns
        self._is_place = np.array([c.kind == "position" for c in columns])
        self.is_gripper = np.array([c.kind == "gripper" for c in columns])
        low, high = (np.array([_or(getattr(c, f), s * FAR) for c in columns]) for f, s in (("low", -1), ("high", 1)))
        self._closed, self._open = np.where(low > -FAR, low, -np.inf), np.where(high < FAR, high, np.inf)
        low, high = np.where(self.is_gripper, -FAR, low), np.where(self.is_gripper, FAR, high)
        scale = np.array([_scale(c.kind, rate_hz) for c in columns]).T
        most = [np.array([_or(getattr(c, f), math.inf) for c in columns]) * s for f, s in zip(("velocity", "acceleration", "jerk"), scale)]
        # A missing limit is replaced by a value that the other limits imply, so that no command reaches it.
        self._low, self._high = np.where(self._is_place, low, -np.inf), np.where(self._is_place, high, np.inf)
        step = np.minimum(most[0], np.where(self._is_place, np.maximum(high - low, 0), FAR))
        self._slowest = np.where(self._is_place, -step, np.maximum(low, -step))
        self._fastest = np.where(self._is_place, step, np.minimum(high, step))
        self._acceleration = np.minimum(most[1], 2 * (self._fastest - self._slowest) + SLACK)
        self._jerk = np.minimum(most[2], 2 * self._acceleration)
        self.reset()

    def reset(self) -> None:
        """Forgets the commands; columns of positions then need `rest_at` again."""
        n = len(self._is_place)
        self._place = np.where(self._is_place | self.is_gripper, np.nan, 0.0)
        self._velocity, self._change = np.zeros(n), np.zeros(n)
        self._stop = np.zeros((0, n))

    def rest_at(self, values: Any) -> None:
        """The robot rests at these values; values of velocities and differences are ignored and taken as zero.

        Errors: UsageError for a position outside its limits, from which no command would be permitted.
        """
        values = finite_row("rest_at", values, len(self._is_place))
        outside = self._is_place & ((values < self._low) | (values > self._high))
        if outside.any():
            i = int(np.argmax(outside))
            column = self.limits.columns[i]
            raise UsageError(f"limits.{column.name}", f"{column.low} to {column.high}", f"{values[i]:g}, where the robot is")
        self.reset()
        self._place = np.where(self._is_place | self.is_gripper, values, 0.0)

    def still(self) -> np.ndarray:
        """The command that stops a robot without position columns: zeros, and for a gripper its last command. float32."""
        return np.where(self.is_gripper, self._place, 0.0).astype(np.float32)

    def step(self, values: Any) -> Tuple[np.ndarray, np.ndarray]:
        """The permitted command nearest to the wanted values, float32, and which columns differ from them.

        Errors: UsageError before `rest_at` where there is a position; BadAction for a value that is not finite.
        """
        wanted = finite_row("command", values, len(self._is_place))
        if np.isnan(self._place).any():
            raise UsageError("limits", "where the robot is: rest_at, or start_at of the loop", "nothing")
        change = np.where(self._is_place, wanted - self._place, np.where(self.is_gripper, 0.0, wanted)) - self._velocity
        low, high = self._span()
        kept = self._stop[0] if len(self._stop) else np.zeros_like(change)
        inside = (change >= low - SLACK * (1 + np.abs(low))) & (change <= high + SLACK * (1 + np.abs(high)))
        best, stops = self._nearest(kept, np.where(inside, change, np.clip(change, np.minimum(low, kept), np.maximum(high, kept))))
        self._change = best
        self._velocity = self._velocity + best
        out = np.where(self._is_place, self._place + self._velocity, self._velocity)
        out = np.where(self.is_gripper, np.clip(wanted, self._closed, self._open), out)
        is_cut = out.astype(np.float32) != wanted.astype(np.float32)
        out = np.where(is_cut, out + 0.0, wanted)
        self._place = np.where(self._is_place | self.is_gripper, out, 0.0)
        self._stop = stops
        return out.astype(np.float32), is_cut

    def breaks(self, rows: np.ndarray) -> np.ndarray:
        """Whether each row of a chunk breaks a limit, alone or together with the rows before it: one bool per row."""
        rows = np.asarray(rows, np.float64)
        slack = 8 * np.finfo(np.float32).eps * np.abs(rows).max(0, initial=0)  # rounding of float32 rows and their differences
        velocity = np.where(self._is_place, np.diff(rows, axis=0, prepend=rows[:1]), np.where(self.is_gripper, 0.0, rows))
        broken = self._is_place & ((rows < self._low - slack) | (rows > self._high + slack))
        broken |= self.is_gripper & ((rows < self._closed - slack) | (rows > self._open + slack))
        broken |= (velocity < self._slowest - slack) | (velocity > self._fastest + slack)
        index = np.arange(len(rows))[:, None]
        first = np.where(self._is_place, 2, 1)  # first row with a known acceleration, which needs two velocities
        for n, most in enumerate((self._acceleration, self._jerk)):
            change = np.diff(velocity, n + 1, axis=0, prepend=np.zeros((n + 1, rows.shape[1])))
            broken |= (index >= first + n) & (np.abs(change) > most + 2 ** (n + 1) * slack)
        return broken.any(1)

    # --- inside ----------------------------------------------------------------------------------------------------------------

    def _span(self) -> Tuple[np.ndarray, np.ndarray]:
        """The smallest and the largest acceleration of this step within every limit."""
        ahead = self._place + self._velocity
        low = np.maximum.reduce([-self._acceleration, self._change - self._jerk, self._slowest - self._velocity, self._low - ahead])
        high = np.minimum.reduce([self._acceleration, self._change + self._jerk, self._fastest - self._velocity, self._high - ahead])
        return low, high

    def _nearest(self, kept: np.ndarray, wanted: np.ndarray) -> Tuple[np.ndarray, np.ndarray]:
        """For each column the acceleration nearest to the wanted one after which a stop exists, and that stop.

        The bisection ends when its two ends, one with a stop and one without, round to the same float32 command.
        """
        stops = self._stops(wanted)
        if stops.found.all():
            return wanted, stops.steps
        n = max(len(stops.steps), len(self._stop))
        best = np.where(stops.found, wanted, kept)
        plan = np.where(stops.found, _padded(stops.steps, n), _padded(self._stop[1:], n))
        near, far = np.where(stops.found, 1.0, 0.0), np.ones(len(wanted))  # positions between kept (0) and wanted (1)
        ahead = np.where(self._is_place, self._place + self._velocity, self._velocity)
        beyond = wanted  # the nearest acceleration without a stop so far
        for _ in range(N_HALF):
            is_open = (near < far) & ((ahead + best).astype(np.float32) != (ahead + beyond).astype(np.float32))
            if not is_open.any():
                break
            share = (near + far) / 2
            tried = kept + share * (wanted - kept)
            stops = self._stops(tried)
            better = stops.found & is_open
            n = max(n, len(stops.steps))
            best, plan = np.where(better, tried, best), np.where(better, _padded(stops.steps, n), _padded(plan, n))
            near = np.where(better, share, near)
            far, beyond = np.where(is_open & ~better, share, far), np.where(is_open & ~better, tried, beyond)
        return best, plan

    def _stops(self, change: np.ndarray) -> Stops:
        """The shortest stop of each column after a step with this acceleration.

        A stop of n steps is a sequence of accelerations whose sum cancels the velocity. The limits bound each acceleration, forwards from
        the current one and backwards from rest (`_bounds`). The bounds are convex, so every interpolation between all lower and all upper
        bounds keeps them, and the sums of the bounds give the share that cancels the velocity. A stop of n steps is also one of n + 1
        steps, so bisection finds the least n.
        """
        velocity = self._velocity + change
        place = np.where(self._is_place, self._place + velocity, 0.0)
        n = self._least_steps(velocity, change)
        least, most = self._least_sum(change, n), -self._least_sum(-change, n)
        room = most - least
        share = np.clip(np.divide(-velocity - least, room, out=np.zeros_like(room), where=room > 0), 0, 1)
        low, high = self._bounds(change, n)
        after = np.arange(1, len(low) + 1)[:, None] > n + 1
        steps = low + share * (high - low)
        speeds = velocity + np.cumsum(steps, 0)
        places = place + np.cumsum(speeds, 0)
        slack = SLACK * (1 + np.abs(self._fastest))
        found = (n >= 0) & (velocity >= self._slowest - slack) & (velocity <= self._fastest + slack)
        found &= (after | ((speeds >= self._slowest - slack) & (speeds <= self._fastest + slack))).all(0)
        edge = SLACK * (1 + np.where(self._is_place, np.abs(place), 0.0))
        within = after | ((places >= self._low - edge) & (places <= self._high + edge))
        found &= ~self._is_place | (within.all(0) & (place >= self._low - edge) & (place <= self._high + edge))
        return Stops(found, steps)

    def _least_steps(self, velocity: np.ndarray, change: np.ndarray) -> np.ndarray:
        """The least number of steps after which each column can rest; -1 if that is above MAX_STOP."""

        def enough(n: np.ndarray) -> np.ndarray:
            slack = SLACK * (1 + np.abs(velocity))
            rests = np.abs(change) <= (n + 1) * self._jerk * (1 + ROUNDING)  # with more tolerance, n + 1 steps could fail where n suffice
            return rests & (self._least_sum(change, n) <= -velocity + slack) & (-self._least_sum(-change, n) >= -velocity - slack)

        few, many = np.full(len(change), -1), np.zeros(len(change), int)
        ok = enough(many)
        while not ok.all() and many.max() < MAX_STOP:
            few, many = np.where(ok, few, many), np.where(ok, many, 2 * many + 1)
            ok = enough(many)
        reachable = ok
        while (reachable & (many - few > 1)).any():
            middle = np.maximum((few + many) // 2, 0)
            ok = enough(middle)
            few, many = np.where(ok, few, middle), np.where(ok, middle, many)
        return np.where(reachable, many, -1)

    def _least_sum(self, change: np.ndarray, n: np.ndarray) -> np.ndarray:
        """The sum of the lower bounds of `_bounds` over n steps: they fall by the jerk per step from the current acceleration, stay at the
        minimum, and rise by the jerk per step to rest."""
        most, jerk = self._acceleration, self._jerk
        fall = np.clip(np.floor(np.minimum((change + most) / jerk, ((n + 1) * jerk + change) / (2 * jerk))), 0, n)
        rise = np.minimum(n - fall, np.floor(most / jerk))
        return fall * change - jerk * (fall * (fall + 1) / 2 + rise * (rise + 1) / 2) - (n - fall - rise) * most

    def _bounds(self, change: np.ndarray, n: np.ndarray) -> Tuple[np.ndarray, np.ndarray]:
        """Bounds of the accelerations in steps 1 to n, from the current acceleration to rest: [steps, columns], zeros after the end.

        A column with n = 0 must be able to rest within the jerk limit; if it cannot, its lower bound is above its upper bound.
        """
        i = np.arange(1, max(int(n.max()), 0) + 2)[:, None]
        forth, back = i * self._jerk, np.maximum(n + 1 - i, 0) * self._jerk
        low = np.maximum(np.maximum(-self._acceleration, change - forth), -back)
        high = np.minimum(np.minimum(self._acceleration, change + forth), back)
        after = i > n + 1
        return np.where(after, 0.0, low), np.where(after, 0.0, high)


def gripper(name: str, unit: str, low: float, high: float) -> Column:
    """The limits of a gripper that was commanded between these values; no limits if the values are equal."""
    return Column(name, "gripper", unit, low, high) if low < high else Column(name, "gripper", unit)


def finite_row(where: str, values: Any, n: int) -> np.ndarray:
    """The values as n finite doubles. Errors: BadAction."""
    row = np.array(values, np.float64)
    if row.shape != (n,) or not np.isfinite(row).all():
        raise BadAction(where, f"{n} finite numbers", str(values))
    return row


def _padded(steps: np.ndarray, n: int) -> np.ndarray:
    return np.concatenate([steps, np.zeros((n - len(steps), steps.shape[1]))])


def _scale(kind: str, rate_hz: float) -> Tuple[float, float, float]:
    """Factors from units and seconds to changes per step, for velocity, acceleration and jerk."""
    first = 1.0 if kind == "velocity" else 1 / rate_hz
    return first, first / rate_hz, first / (rate_hz * rate_hz)


def _or(value: Optional[float], other: float) -> float:
    return other if value is None else value


def _number(where: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= FAR:
        raise UsageError(where, f"a number up to {FAR:g}", str(value)[:80])
    return float(value)


def _parse_column(name: str, given: Any) -> Column:
    where = f"limits.{name}"
    known = {"kind", "unit", "range", "velocity", "acceleration", "jerk"}
    if not isinstance(given, dict) or not {"kind", "unit"} <= set(given) <= known:
        raise UsageError(where, f'an object with kind and unit, and of {", ".join(sorted(known - {"kind", "unit"}))} what is limited', str(given)[:80])
    if not isinstance(given["unit"], str):
        raise UsageError(f"{where}.unit", "a text", str(given["unit"])[:80])
    span = given.get("range", [None, None])
    if not isinstance(span, list) or len(span) != 2:
        raise UsageError(f"{where}.range", "[least, largest]", str(span)[:80])
    low, high = (None if end is None else _number(f"{where}.range", end) for end in span)
    most = {field: _number(f"{where}.{field}", given[field]) for field in ("velocity", "acceleration", "jerk") if field in given}
    return Column(name, given["kind"], given["unit"], low, high, **most)


def _document(column: Column) -> Dict[str, Any]:
    fields = {key: value for key, value in asdict(column).items() if value is not None and key not in ("name", "low", "high")}
    if column.low is not None or column.high is not None:
        fields["range"] = [column.low, column.high]
    return fields


def _check(column: Column) -> None:
    where = f"limits.{column.name}"
    if column.kind not in KINDS:
        raise UsageError(f"{where}.kind", f'one of {", ".join(KINDS)}', str(column.kind))
    for field in ("velocity", "acceleration", "jerk"):
        value = getattr(column, field)
        if value is not None and column.kind == "gripper":
            raise UsageError(f"{where}.{field}", "none of a gripper, which may jump; one that is slowed is a position", str(value))
        if value is not None and not 0 < value <= FAR:
            raise UsageError(f"{where}.{field}", "a number above 0", str(value))
    low, high = _or(column.low, -FAR), _or(column.high, FAR)
    if not low < high:
        raise UsageError(f"{where}.range", "the least below the largest", f"[{column.low}, {column.high}]")
    if column.kind in ("velocity", "difference") and not low <= 0 <= high:
        raise UsageError(f"{where}.range", f"zero in the range of a {column.kind}: the robot has to be able to stop", f"[{column.low}, {column.high}]")


def _check_names(given: Mapping[str, Any], spec: Spec) -> None:
    missing = [name for name in spec.action_names if name not in given]
    extra: List[str] = [name for name in given if name not in spec.action_names]
    if not spec.action_names or missing or extra:
        found = f"without {', '.join(missing)}" if missing else f"with {', '.join(extra)}" if extra else "a policy whose actions have no names"
        raise UsageError("limits", f"the actions of {spec.bundle.name}: {', '.join(spec.action_names)}", found)

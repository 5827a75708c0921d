# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Random lives of a schedule, and beside each the plain bookkeeping by which a test judges it."""

import os
from dataclasses import dataclass
from typing import Dict, List, Optional

import numpy as np
from hypothesis import strategies as st

from vla_cpp.control import Action, Blend, ChunkSchedule, CrossFade, Ensemble

N_EXAMPLE = int(os.environ.get("VLA_EXAMPLES", 150))


@dataclass
class Life:
    horizon: int
    d_action: int
    replan_every: int
    blend: Blend
    max_age: Optional[int]
    max_jump: Optional[float]
    events: list  # per call of `next`: (ticks since the last, latency of an observation taken now in ticks, or None: it fails)
    seed: int


@dataclass
class Moment:
    """One call of `next`, with what an onlooker knows at that time."""

    action: Action
    step: int  # consumed before
    last: Optional[np.ndarray]  # command before
    received: Dict[int, tuple]  # tick of the observation -> (step of the observation, rows, step at receipt)
    fades: Dict[int, int]  # tick of the observation -> steps of its fade
    was_missed: bool  # a tick went by without a call


NONE = st.none()
AGES = st.one_of(st.none(), st.integers(0, 15))
BLENDS = st.one_of(st.builds(CrossFade, st.integers(0, 6)), st.builds(Ensemble, st.floats(0, 3)))


@st.composite
def lives(draw, blend=BLENDS, max_gap=3, jump=NONE, age=AGES):
    horizon = draw(st.integers(1, 12))
    latency = st.one_of(st.integers(0, 3), st.integers(0, 2 * horizon + 2), st.none())
    event = st.tuples(st.one_of(st.just(1), st.integers(1, max_gap)), latency)
    return Life(
        horizon,
        draw(st.integers(1, 2)),
        draw(st.integers(1, horizon)),
        draw(blend),
        draw(age),
        draw(jump),
        draw(st.lists(event, min_size=1, max_size=60)),
        draw(st.integers(0, 99)),
    )


def hold_last(last, tick):
    return last


def make(life, on_late=hold_last):
    return ChunkSchedule(
        horizon=life.horizon, d_action=life.d_action, replan_every=life.replan_every, blend=life.blend,
        on_late=on_late, max_age=life.max_age, max_jump=life.max_jump,
    )  # fmt: skip


def live(life, schedule=None) -> List[Moment]:
    schedule = schedule or make(life)
    random = np.random.default_rng(life.seed)
    moments, received, fades = [], {}, {}
    tick, step, last, flight = -1, 0, None, None

    def land():
        nonlocal flight
        observed, observed_step, due = flight
        flight = None
        if due is None:
            schedule.fail()
            return
        rows = random.uniform(-5, 5, (life.horizon, life.d_action)).astype(np.float32)
        if schedule.receive(rows, tick):
            fades[observed] = schedule._sources[-1].fade
        received[observed] = (observed_step, rows, step)

    for gap, latency in life.events:
        tick += gap
        if flight and (flight[2] is None or flight[2] <= tick):
            land()
        if schedule.wants(tick):
            schedule.observe(tick)
            flight = (tick, step, None if latency is None else tick + latency)
            if latency == 0:
                land()
        action = schedule.next(tick)
        moments.append(Moment(action, step, last, dict(received), dict(fades), gap > 1))
        step += not action.held
        last = action.values
    return moments


def admissible(life, moment):
    """Ticks of the observations whose chunks have a row for this moment, by the rules alone."""
    return [
        tick
        for tick, (step, _, _) in moment.received.items()
        if moment.step < step + life.horizon and (life.max_age is None or moment.action.tick - tick <= life.max_age)
    ]


def row(moment, source, step):
    """The row of a source for a step: of a chunk, or the command that was held when its fade began (then source is the values)."""
    if isinstance(source, np.ndarray):
        return source.astype(np.float64)
    observed_step, rows, _ = moment.received[source]
    return rows[step - observed_step].astype(np.float64)

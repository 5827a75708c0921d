# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""A world without a simulator: a point in a box that the mean of each action pushes along a line.

It needs nothing but numpy and runs in microseconds, so that the harness itself can be tested with any bundle: frames and states
have the sizes that it is told, an episode is solved when the point has moved far enough, and equal seeds give equal episodes.
"""

from __future__ import annotations

from typing import Any, Dict, List

import numpy as np

from ..environment import Declaration, Environment, Observation


class Null(Environment):
    """`still` is never solved; `drift` is solved when the actions have added up to 1 in either direction."""

    name = "null"

    def __init__(self, task: str, view: str = "camera", state: str = "state", d_state: int = 4, d_action: int = 4) -> None:
        self.task = task
        self.declaration = Declaration(
            views={view: (32, 32)},
            states={state: d_state},
            d_action=d_action,
            low=-1.0,
            high=1.0,
            rate_hz=10.0,
            limit=40,
            replan_every=8,
            conventions="pixels and states are noise of the seed, shifted by the position",
        )
        self._view, self._state = view, state

    @classmethod
    def fit(cls, spec: Any) -> Dict[str, Any]:
        """The options that make this world fit a policy with one view and one state, whatever their names and sizes."""
        view, state = spec.views[0], spec.states[0]
        return {"view": view.name, "state": state.name, "d_state": state.width, "d_action": spec.d_action}

    @classmethod
    def tasks(cls) -> List[str]:
        return ["drift", "still"]

    def instruction(self) -> str:
        return "stay where you are" if self.task == "still" else "drift away"

    def reset(self, seed: int) -> None:
        draw = np.random.default_rng(seed)
        self._pixels = draw.integers(0, 256, (32, 32, 3), dtype=np.uint8)
        self._values = draw.standard_normal(self.declaration.states[self._state]).astype(np.float32)
        self._position = 0.0

    def observe(self) -> Observation:
        shift = np.uint8(int(100 * self._position) % 256)
        values = (self._values + np.float32(self._position)).astype(np.float32)
        return Observation({self._view: self._pixels + shift}, {self._state: values})

    def step(self, action: np.ndarray) -> bool:
        self._position += float(action.mean())
        return self.task == "drift" and abs(self._position) >= 1.0

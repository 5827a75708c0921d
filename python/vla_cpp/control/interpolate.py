# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Interpolates commands from a policy's rate to the rate of a faster controller.

A command is reached at the end of its control period, so interpolated commands come one period later than the original ones (`delay_s`).
Within the period a position follows a polynomial from its current value to the command:

    linear        degree 1: continuous position
    cubic         degree 3, from the current velocity to the mean velocity between the last two commands: continuous velocity
    minimum_jerk  degree 5, as cubic, and from the current acceleration to zero: continuous acceleration. Among all motions with these end
                  conditions it has the least squared jerk (Flash and Hogan 1985)

So a new or late chunk causes no jump. A polynomial may slightly overshoot where a motion reverses; a Limiter at the controller's rate keeps
it within limits. A velocity or gripper command is held for the period. A difference is spread over the period: its parts sum to it.
"""

from __future__ import annotations

from typing import Any, Dict, Sequence, Tuple

import numpy as np

from ..errors import UsageError
from .limits import KINDS, finite_row

# Matrices from the end conditions (position, velocity and acceleration at s = 0, then at s = 1) to the coefficients of s^0 ... s^5; s goes
# from 0 to 1 over a period.
METHODS: Dict[str, np.ndarray] = {
    "linear": np.array([[1, -1], [0, 0], [0, 0], [0, 1], [0, 0], [0, 0]], float).T,
    "cubic": np.array([[1, 0, -3, 2], [0, 1, -2, 1], [0, 0, 0, 0], [0, 0, 3, -2], [0, 0, -1, 1], [0, 0, 0, 0]], float).T,
    "minimum_jerk": np.array(
        [
            [1, 0, 0, -10, 15, -6],
            [0, 1, 0, -6, 8, -3],
            [0, 0, 0.5, -1.5, 1.5, -0.5],
            [0, 0, 0, 10, -15, 6],
            [0, 0, 0, -4, 7, -3],
            [0, 0, 0, 0.5, -1, 0.5],
        ]
    ).T,
}


class Interpolator:
    """Interpolates commands within control periods.

        between = Interpolator(["position"] * 6 + ["velocity"], method="minimum_jerk", rate_hz=20)
        between.start_at(joints())
        while running:                          # 20 times a second
            action = loop.step(observe)
            between.to(action.values)
            for s in (0.1, 0.2, ..., 1.0):      # 200 times a second
                command(between.at(s))

    kinds    "position", "velocity", "difference" or "gripper" of each column
    method   how positions are interpolated: "linear", "cubic" or "minimum_jerk"
    rate_hz  control periods per second
    """

    def __init__(self, kinds: Sequence[str], *, method: str, rate_hz: float) -> None:
        if not kinds or not set(kinds) <= set(KINDS):
            raise UsageError("kinds", f'one of {", ".join(KINDS)} for each column', str(list(kinds)))
        if method not in METHODS:
            raise UsageError("method", f'one of {", ".join(METHODS)}', str(method))
        if not 0 < rate_hz < float("inf"):
            raise UsageError("rate_hz", "periods per second, above 0", str(rate_hz))
        self.delay_s = 1 / rate_hz
        self._powers = METHODS[method]
        self._is_place = np.array([kind == "position" for kind in kinds])
        self._is_held = np.array([kind in ("velocity", "gripper") for kind in kinds])
        self._command = np.full(len(kinds), np.nan)
        self._coefficients = np.zeros((len(self._powers), len(kinds)))
        self._s = 1.0

    def start_at(self, values: Any) -> None:
        """The robot rests at these values; values of velocities and differences are ignored and taken as zero."""
        self._command = np.where(self._is_place, finite_row("start_at", values, len(self._is_place)), 0.0)
        self._coefficients[:] = 0
        self._coefficients[0] = self._command
        self._s = 1.0

    def to(self, values: Any) -> None:
        """Begins a control period, at whose end this command is reached. The motion continues from the last call of `at`.

        Errors: UsageError before `start_at`; BadAction for a value that is not finite.
        """
        wanted = finite_row("command", values, len(self._is_place))
        if np.isnan(self._command).any():
            raise UsageError("command", "start_at first: where the robot is", "nothing")
        place, velocity, acceleration = self._motion(self._s)
        ends = [place, velocity, acceleration, wanted, wanted - self._command, np.zeros_like(wanted)]
        self._coefficients = self._powers @ np.array(ends)
        self._command, self._s = wanted, 0.0

    def at(self, s: float) -> np.ndarray:
        """The command, float32, at this share of the period: above the share of the last call, at most 1.

        For a difference it is the part since the last call.
        """
        if not self._s < s <= 1:
            raise UsageError("s", f"a share of the period above {self._s:g}, 1 at most", str(s))
        place, _, _ = self._motion(s)
        rest = np.where(self._is_held, self._command, (s - self._s) * self._command)
        self._s = s
        return np.where(self._is_place, place, rest).astype(np.float32)

    def _motion(self, s: float) -> Tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Position, velocity and acceleration of the polynomials, with the period as unit of time."""
        n = len(self._coefficients)
        k = np.arange(n)
        power = [s**k, k * s ** np.maximum(k - 1, 0), k * (k - 1) * s ** np.maximum(k - 2, 0)]
        place, velocity, acceleration = (p @ self._coefficients for p in power)
        return place, velocity, acceleration

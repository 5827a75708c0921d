# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What a simulator must offer to be evaluated in, and a guard that holds it to its own word."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Dict, List, Mapping, Optional, Tuple

import numpy as np

from .smoothness import smoothness


class EnvironmentFault(Exception):
    """An environment broke its own declaration. Says which, what was declared and what came."""


@dataclass(frozen=True)
class Declaration:
    """What an environment shows and takes; everything that a reader of results must know about its conventions.

    views        cameras by name: (height, width) in pixels
    states       state vectors by name: number of values
    d_action     values of an action
    low, high    the range that `step` executes; actions outside are clipped, and the share of clipped ones is reported
    rate_hz      control steps per second of the simulated robot
    limit        steps after which an episode has failed
    replan_every steps executed of a chunk before the next look, unless the caller says otherwise
    conventions  text for people: turned images, frames of reference, units
    gripper      the column of an action that commands the gripper, if one does
    """

    views: Mapping[str, Tuple[int, int]]
    states: Mapping[str, int]
    d_action: int
    low: float
    high: float
    rate_hz: float
    limit: int
    replan_every: int
    conventions: str
    gripper: Optional[int] = None


@dataclass
class Observation:
    """frames: uint8 (height, width, 3) RGB, upright, by view; state: float32 vectors by name."""

    frames: Dict[str, np.ndarray]
    state: Dict[str, np.ndarray]


class Environment:
    """One simulated task. Subclasses are adapters: small, and with everything simulator-specific inside.

    name          of the adapter, e.g. "metaworld"
    task          which of its tasks this is
    declaration   see above
    one_at_a_time whether a task is so large or slow to make that a process holds one only, and does all of its episodes first
    """

    name = ""
    task = ""
    one_at_a_time = False
    declaration: Declaration

    @classmethod
    def tasks(cls) -> List[str]:
        """The tasks that `make` takes."""
        raise NotImplementedError

    @classmethod
    def suites(cls) -> Dict[str, List[str]]:
        """The tasks by suite, where there are so many that a run names its suites; then a task is `suite/...`."""
        return {}

    @classmethod
    def declare(cls, task: str, **options: Any) -> Declaration:
        """The declaration of a task, without starting a simulator where the class knows it."""
        return getattr(cls, "declaration", None) or cls(task, **options).declaration  # type: ignore[call-arg]

    def instruction(self) -> str:
        """The sentence that asks for the task."""
        raise NotImplementedError

    def reset(self, seed: int) -> None:
        """Puts everything where this seed says: equal seeds, equal episodes."""
        raise NotImplementedError

    def observe(self) -> Observation:
        """What the robot sees and feels now. May be slow: it is called once per look, not per step."""
        raise NotImplementedError

    def step(self, action: np.ndarray) -> bool:
        """Executes one action, float32 (d_action,) within [low, high]; whether the task is solved now."""
        raise NotImplementedError

    def close(self) -> None:
        """Releases the simulator."""


class Guard:
    """An environment that is held to its declaration: every mismatch is an EnvironmentFault that names it."""

    def __init__(self, environment: Environment) -> None:
        self.inner, self.declaration = environment, environment.declaration
        self.label = f"environment {environment.name}, task {environment.task}"
        self.clipped, self.executed, self.borders = 0, [], []

    def reset(self, seed: int) -> None:
        self.inner.reset(seed)
        self.clipped, self.executed, self.borders = 0, [], []

    def begin_chunk(self) -> None:
        """The next action is the first of another chunk."""
        self.borders.append(len(self.executed))

    def smoothness(self) -> Dict[str, float]:
        """Of the actions since `reset`."""
        actions = np.reshape(self.executed, (len(self.executed), self.declaration.d_action))
        return smoothness(actions, self.borders, self.declaration.gripper)

    def instruction(self) -> str:
        text = self.inner.instruction()
        if not isinstance(text, str) or not text.strip():
            raise EnvironmentFault(f"{self.label}: expected an instruction, found {text!r}")
        return text

    def observe(self) -> Observation:
        seen = self.inner.observe()
        self._check_names("views", self.declaration.views, seen.frames)
        self._check_names("states", self.declaration.states, seen.state)
        for name, size in self.declaration.views.items():
            self._check_array(f"view {name}", seen.frames[name], (*size, 3), np.uint8)
        for name, width in self.declaration.states.items():
            values = seen.state[name]
            self._check_array(f"state {name}", values, (width,), np.float32)
            if not np.isfinite(values).all():
                raise EnvironmentFault(f"{self.label}: state {name}: expected finite numbers, found {values.tolist()}")
        return seen

    def step(self, action: np.ndarray) -> bool:
        low, high = self.declaration.low, self.declaration.high
        within = np.clip(action, low, high).astype(np.float32)
        self.executed.append(within)
        self.clipped += bool((within != action).any())
        solved = self.inner.step(within)
        if not isinstance(solved, (bool, np.bool_)):
            raise EnvironmentFault(f"{self.label}: step: expected True or False, found {solved!r}")
        return bool(solved)

    def _check_names(self, what: str, declared: Mapping[str, Any], found: Mapping[str, Any]) -> None:
        if set(declared) != set(found):
            raise EnvironmentFault(f"{self.label}: {what}: declared {sorted(declared)}, found {sorted(found)}")

    def _check_array(self, what: str, value: Any, shape: Tuple[int, ...], dtype: type) -> None:
        if not isinstance(value, np.ndarray) or value.shape != shape or value.dtype != dtype:
            found = f"{value.dtype} {value.shape}" if isinstance(value, np.ndarray) else type(value).__name__
            raise EnvironmentFault(f"{self.label}: {what}: declared {np.dtype(dtype)} {shape}, found {found}")

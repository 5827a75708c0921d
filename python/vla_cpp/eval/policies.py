# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Whatever can drive a robot in an episode, behind one call."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Dict, Optional, Sequence, Tuple

import numpy as np

from .environment import Observation

OPENPI = ("openpi://", "ws://", "wss://")  # how the address of a server of that protocol begins


@dataclass
class Answer:
    """actions: float32 (horizon, d_action) in the robot's units. engine_ms: what the policy itself took, without the way there."""

    actions: np.ndarray
    engine_ms: float
    stages: Dict[str, float]


class EvalPolicy:
    """identity     which weights: a checksum or a name
    noise_shape  (noise_rows, d_noise) of the noise that `act` wants
    """

    identity = ""
    noise_shape: Tuple[int, int] = (0, 0)

    def act(self, observation: Observation, text: str, noise: np.ndarray) -> Answer:
        raise NotImplementedError

    def close(self) -> None:
        """Releases what the policy holds."""


class ServedPolicy(EvalPolicy):
    """A bundle at `vla serve`, through the public client. embodiment: the tag of its robot, where it is for several."""

    def __init__(self, address: str, timeout: float, embodiment: Optional[str] = None) -> None:
        import vla_cpp

        self._client = vla_cpp.Client(address, timeout=timeout)
        self._robot = self._client.robot(embodiment)
        self.spec = self._robot.spec
        self.identity = self.spec.bundle.checksum
        self.noise_shape = (self.spec.noise_rows, self.spec.d_noise)

    def chunk(self, observation: Observation, text: str, noise: np.ndarray, leftover: Any = None) -> Any:
        """The client's chunk; `leftover`: rows of the one before, where it is to go on from them."""
        return self._robot.act(images=observation.frames, state=observation.state, text=text, noise=noise, leftover=leftover)

    def act(self, observation: Observation, text: str, noise: np.ndarray) -> Answer:
        chunk = self.chunk(observation, text, noise)
        return Answer(np.asarray(chunk), sum(chunk.timing.values()), dict(chunk.timing))

    def close(self) -> None:
        self._client.close()


class OpenpiPolicy(EvalPolicy):
    """Any server of openpi's protocol. names: the lines of OpenpiClient, for the views and states of the environment.

    The protocol has no place for noise: `vla serve` takes a seed, made from the episode's noise; another server draws its own.
    """

    noise_shape = (1, 2)

    def __init__(self, address: str, timeout: float, names: Sequence[str]) -> None:
        from ..openpi import OpenpiClient

        self._client = OpenpiClient(address, names, timeout=timeout)
        self.identity = self._client.identity
        noise = "" if self._client.takes_seeds else ", whose noise no seed fixes"
        self.label = f"{self._client.name} over openpi's protocol{noise}"

    def act(self, observation: Observation, text: str, noise: np.ndarray) -> Answer:
        seed = int(noise.view(np.uint64)[0, 0]) >> 1 if self._client.takes_seeds else None
        chunk = self._client.act(images=observation.frames, state=observation.state, text=text, seed=seed)
        return Answer(np.asarray(chunk), sum(chunk.timing.values()), dict(chunk.timing))

    def close(self) -> None:
        self._client.close()


class TorchPolicy(EvalPolicy):
    """A LeRobot checkpoint in PyTorch, float32, on one thread: the reference."""

    def __init__(self, checkpoint: str) -> None:
        import time

        from . import lerobot_reference as reference
        import torch

        torch.set_num_threads(1)
        self._clock, self._reference = time.perf_counter, reference
        self._policy, self._before, self._after = reference.load(checkpoint)
        config = self._policy.config
        self.identity = f"torch:{reference.identity(checkpoint)}"
        self.noise_shape = (config.chunk_size, config.max_action_dim)

    def act(self, observation: Observation, text: str, noise: np.ndarray) -> Answer:
        begin = self._clock()
        actions = self._reference.predict(
            self._policy, self._before, self._after, observation.frames, observation.state, text, noise
        )
        return Answer(actions, 1e3 * (self._clock() - begin), {})


class RandomPolicy(EvalPolicy):
    """Uniform actions in [-1, 1], by the episode's own noise: the floor that any policy must leave."""

    identity = "random"

    def __init__(self, horizon: int, d_action: int) -> None:
        self.noise_shape = (horizon, d_action)

    def act(self, observation: Observation, text: str, noise: np.ndarray) -> Answer:
        draw = np.random.default_rng(noise.view(np.uint32).ravel()[:4])
        return Answer(draw.uniform(-1, 1, noise.shape).astype(np.float32), 0.0, {})


def make_policy(description: Dict[str, Any]) -> EvalPolicy:
    """A policy from what a worker process was told: {"kind": "served", "address": ...} and so on."""
    kind = description["kind"]
    if kind == "served":
        return ServedPolicy(description["address"], description["timeout"], description["embodiment"])
    if kind == "openpi":
        return OpenpiPolicy(description["address"], description["timeout"], description["names"])
    if kind == "torch":
        return TorchPolicy(description["checkpoint"])
    return RandomPolicy(description["horizon"], description["d_action"])

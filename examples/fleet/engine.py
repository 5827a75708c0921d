# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""A policy in this process that takes messages of openpi's clients and gives answers to them. Ray is not known here."""

import os
import socket
from typing import Any, Dict, Mapping, Optional, Sequence, Union

import numpy as np

import vla_cpp
from vla_cpp import openpi
from vla_cpp.observation import named

PROMPT = "prompt"  # openpi's key of the instruction


class Engine:
    """bundle   of vla-convert
    names    KEY=NAME, a line for each key of the robots' messages: the view or state of the policy that it stands for, or `text`.
             None: every view and state has its own name, and the instruction is `prompt`
    threads, kernels  those of vla_cpp.Policy

    Errors: those of Policy, and UsageError where the names are not those of the policy.
    """

    def __init__(self, bundle: str, names: Optional[Sequence[str]] = None, threads: int = 1, kernels: Optional[str] = None) -> None:
        self._policy = vla_cpp.Policy(bundle, threads=threads, kernels=kernels)
        self.replica = f"{socket.gethostname()}:{os.getpid()}"
        self._views = [view.name for view in self._policy.spec.views]
        self._states = [state.name for state in self._policy.spec.states]
        own = [f"{name}={name}" for name in self._views + self._states] + [f"{PROMPT}={openpi.TEXT}"]
        self._names = dict(openpi.pairs_of(names or own))
        known = {*self._views, *self._states, openpi.TEXT}
        if not set(self._names.values()) <= known:
            raise vla_cpp.UsageError("names", "lines for " + ", ".join(sorted(known)), ", ".join(self._names.values()))
        self._warm_up()

    def greeting(self) -> bytes:
        """The metadata that openpi's servers send first, with the members of vla serve's, and which replica this is."""
        spec = self._policy.spec
        return openpi.pack(
            {
                "server": f"vla.cpp {vla_cpp.__version__}",  # which tells OpenpiClient that seeds are taken
                "replica": self.replica,
                "bundle": spec.bundle.name,
                "checksum": spec.bundle.checksum,
                "precision": spec.precision,
                "control_hz": spec.rate_hz,
                "action_horizon": spec.horizon,
                "action_dim": spec.d_action,
                "action_names": list(spec.action_names),
                "names": ", ".join(f"{key}={name}" for key, name in self._names.items()),
            }
        )

    def act(self, message: Union[bytes, str], queue_ms: float = 0.0) -> Union[bytes, str]:
        """The answer to an observation; text where it is refused, which begins with the error's code."""
        try:
            chunk = self._policy.act(**self._observation(message))
        except vla_cpp.VlaError as refusal:
            return f"{refusal.code}: {refusal}"
        total = sum(chunk.timing.values())
        return openpi.pack(
            {
                "actions": chunk.actions,
                "seed": chunk.seed,
                "notes": list(chunk.notes),
                "policy_timing": {"infer_ms": total},
                "server_timing": {"infer_ms": total, "queue_ms": queue_ms},
                "replica": self.replica,
            }
        )

    def _observation(self, message: Union[bytes, str]) -> Dict[str, Any]:
        """The arguments of Policy.act. Errors: Incompatible, BadObservation."""
        content = openpi.unpack(message, "message")
        if not isinstance(content, dict):
            raise vla_cpp.BadObservation("message", "a map of " + ", ".join(self._names), type(content).__name__)
        images = content.pop("images", {})
        content.update((f"images/{key}", image) for key, image in named("images", images))
        seed = self._seed_of(content.pop("vla", {}))
        if set(content) != set(self._names):
            found = ", ".join(sorted(map(str, content))) or "none"
            raise vla_cpp.BadObservation("message", "the keys " + ", ".join(sorted(self._names)), found)
        given = {self._names[key]: value for key, value in content.items()}
        return {
            "images": {name: given[name] for name in self._views if name in given},
            "state": {name: given[name] for name in self._states if name in given},
            "text": given.get(openpi.TEXT),
            "seed": seed,
        }

    @staticmethod
    def _seed_of(extension: object) -> Optional[int]:
        """Of `vla` in an observation, as vla serve reads it. Its deadline is not read, and is refused rather than not kept."""
        if not isinstance(extension, Mapping) or not set(extension) <= {"seed"}:
            raise vla_cpp.BadObservation("vla", "a map with `seed` and nothing else", str(extension)[:80])
        seed = extension.get("seed")
        if seed is not None and (not isinstance(seed, int) or not 0 <= seed < 2**63):
            raise vla_cpp.BadObservation("vla.seed", "0 to 2^63 - 1", str(seed)[:80])
        return seed

    def _warm_up(self) -> None:
        """The first act makes plans; a robot should not wait for them."""
        spec = self._policy.spec
        self._policy.act(
            images={view.name: np.zeros((view.height, view.width, 3), np.uint8) for view in spec.views},
            state={state.name: np.zeros(state.width, np.float32) for state in spec.states},
            text="warm up",
            seed=0,
        )

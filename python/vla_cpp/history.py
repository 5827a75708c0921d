# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Past observations for a policy that reads several moments. The client keeps them: in the runtime an act depends on its message alone."""

from __future__ import annotations

import re
from collections import deque
from typing import Any, Deque, Dict, List, Mapping, Tuple

from .errors import BadObservation
from .observation import State, named
from .spec import Spec

_BEFORE = re.compile(r"(.*)@-([1-9]\d*)")


class History:
    """Keeps the last moments and names the feature of k control steps ago NAME@-k, as such a policy (Diffusion Policy) names it.

        history = vla_cpp.History(policy.spec)
        history.add(images, state)                 # at every control step
        chunk = policy.act(**history.observation)  # whenever rows are needed

    The first moment also fills the places of moments before it, as in LeRobot (policies/utils.py populate_queues). `reset()` begins
    an episode.
    """

    def __init__(self, spec: Spec) -> None:
        names = [feature.name for feature in (*spec.views, *spec.states)]
        found = [match for match in map(_BEFORE.fullmatch, names) if match]
        self.n_moment = 1 + max((int(match[2]) for match in found), default=0)
        self._states = [state.name for state in spec.states if not _BEFORE.fullmatch(state.name)]
        self._moments: Deque[Tuple[Dict[str, Any], Dict[str, Any]]] = deque(maxlen=self.n_moment)

    def reset(self) -> None:
        self._moments.clear()

    def add(self, images: Mapping[str, Any], state: State) -> None:
        """Adds `images` and `state` of one moment, in the form that `act` accepts for a policy that reads a single moment."""
        if not isinstance(state, Mapping):
            if len(self._states) != 1:
                raise BadObservation("state", "a dict of " + ", ".join(self._states), type(state).__name__)
            state = {self._states[0]: state}
        moment = dict(named("images", images)), dict(named("state", state))
        self._moments.extend([moment] * (1 if self._moments else self.n_moment))

    @property
    def observation(self) -> Dict[str, Dict[str, Any]]:
        """`images` and `state` of all moments, as arguments of `act`. Errors: BadObservation before the first `add`."""
        if not self._moments:
            raise BadObservation("history", "a moment or more", "none", "call add() with what is seen now")
        together: List[Dict[str, Any]] = [{}, {}]
        for ago, moment in enumerate(reversed(self._moments)):
            for whole, part in zip(together, moment):
                whole.update({f"{name}@-{ago}" if ago else name: value for name, value in part.items()})
        return {"images": together[0], "state": together[1]}

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Cameras that stopped: the same picture in one act after the other while the robot moves."""

from __future__ import annotations

import threading
from typing import Dict, Mapping, Tuple

import numpy as np

from .errors import VlaError
from .observation import Image, State, image_arg, states_of
from .spec import Spec

N_SAME = 5  # acts: a loop may be faster than its cameras, though not by so much
MOVED = 1e-3  # a millimetre, or a twentieth of a degree in radians


class CameraWatch:
    """What one robot, or several by their tag, showed in the acts before."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._seen: Dict[Tuple[str, str], Tuple[bytes, np.ndarray, int]] = {}  # picture, state when it came, acts since

    def notes(self, spec: Spec, images: Mapping[str, Image], state: State) -> Tuple[str, ...]:
        """A note for each view whose picture stays the same to the byte although the state does not. An observation that the policy
        cannot take is left to what refuses it."""
        try:
            pictures = {name: image_arg(name, image)[1] for name, image in images.items()}
            parts = states_of(state, spec.states)
        except (VlaError, AttributeError):
            return ()
        position = np.concatenate([parts[name].ravel() for name in sorted(parts)]) if parts else np.zeros(0, np.float32)
        with self._lock:
            return tuple(
                f"view {name}: the same picture in {n} acts, while the state moved: does the camera still run?"
                for name, data in pictures.items()
                if data is not None
                for n in [self._count((spec.embodiment, name), bytes(data), position)]
                if n >= N_SAME
            )

    def _count(self, key: Tuple[str, str], picture: bytes, position: np.ndarray) -> int:
        """Acts with this picture, 0 while the state is where it was when the picture came."""
        known, start, n = self._seen.get(key, (None, position, 0))
        if known != picture or start.shape != position.shape:
            start, n = position, 0
        self._seen[key] = picture, start, n + 1
        return n + 1 if position.size and np.abs(position - start).max() > MOVED else 0

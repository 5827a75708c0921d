# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Detects frozen cameras: the same picture in consecutive acts while the robot moves."""

from __future__ import annotations

import threading
from typing import Dict, Mapping, Tuple

import numpy as np

from .errors import VlaError
from .observation import Image, State, image_arg, states_of
from .spec import Spec

N_SAME = 5  # acts with one picture before a note; a control loop may be faster than its cameras, but hardly five times
MOVED = 1e-3  # change of a state that counts as motion: a millimetre in metres, a twentieth of a degree in radians


class CameraWatch:
    """The pictures and states of earlier acts, by robot and view."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._seen: Dict[Tuple[str, str], Tuple[bytes, np.ndarray, int]] = {}  # picture, state when it first appeared, acts since

    def notes(self, spec: Spec, images: Mapping[str, Image], state: State) -> Tuple[str, ...]:
        """A note for each view whose picture stays identical to the byte while the state changes. An invalid observation gets no notes
        here; other checks refuse it."""
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
        """Number of acts with this picture, 0 while the state is the one of the picture's first act."""
        known, start, n = self._seen.get(key, (None, position, 0))
        if known != picture or start.shape != position.shape:
            start, n = position, 0
        self._seen[key] = picture, start, n + 1
        return n + 1 if position.size and np.abs(position - start).max() > MOVED else 0

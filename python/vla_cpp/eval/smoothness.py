# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""How smoothly a robot moved, which success does not tell: from the actions that an episode executed."""

from __future__ import annotations

from typing import Dict, Optional, Sequence

import numpy as np


def smoothness(actions: np.ndarray, borders: Sequence[int], gripper: Optional[int]) -> Dict[str, float]:
    """Of executed actions (n, d_action) in their own units. `borders`: indices of the first action of a chunk; `gripper`: the column
    of the gripper's command, which is left out of all but its own measure.

    action_rate      root mean square of the change from one action to the next, over steps and columns
    jerk             the same of the third difference: the change of acceleration of commanded positions
    border_jump      acceleration (second difference) where a chunk takes over from the one before, over that elsewhere; 1 is no jump
    gripper_flips    how often the gripper's command changes its sign

    A measure for which there are too few actions is left out.
    """
    actions = np.asarray(actions, dtype=np.float64)
    out: Dict[str, float] = {}
    if gripper is not None and len(actions) > 1:
        signs = np.sign(actions[:, gripper])
        signs = signs[signs != 0]
        out["gripper_flips"] = float(np.count_nonzero(signs[1:] != signs[:-1]))
    moves = actions if gripper is None else np.delete(actions, gripper, axis=1)
    if moves.shape[1] == 0:
        return out
    if len(moves) > 1:
        out["action_rate"] = _rms(np.diff(moves, axis=0))
    if len(moves) > 3:
        out["jerk"] = _rms(np.diff(moves, n=3, axis=0))
    second = np.diff(moves, n=2, axis=0)
    # Differences i, from actions i to i + 2, that have actions of both chunks.
    at_border = np.zeros(len(second), dtype=bool)
    for first in borders:
        if first > 0:
            at_border[max(0, first - 2) : first] = True
    if at_border.any() and not at_border.all() and _rms(second[~at_border]) > 0:
        out["border_jump"] = _rms(second[at_border]) / _rms(second[~at_border])
    return out


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def mean_of(measured: Sequence[Dict[str, float]]) -> Dict[str, float]:
    """The mean of each measure over the episodes that have it."""
    names = dict.fromkeys(name for row in measured for name in row)
    return {name: float(np.mean([row[name] for row in measured if name in row])) for name in names}

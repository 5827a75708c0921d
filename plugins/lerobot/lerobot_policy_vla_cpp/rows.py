# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The rows of the chunk before, in the network's own numbers."""

import numpy as np
import vla_cpp


def unexecuted_rows(given: np.ndarray, previous: vla_cpp.Chunk) -> np.ndarray:
    """`previous.normalized` from the row that `given` starts with; where `given` is padded with zeros, so is the result.

    given  (row, d_action) in the robot's units: actions of `previous` from some row on, then rows of zeros or none
           (rollout/inference/rtc.py, _normalize_prev_actions_length, pads what LeRobot's policies then read as normalized rows:
           the zeros are targets of the guidance there and here)
    Errors: BadObservation where the rows are none of `previous`
    """
    horizon = len(previous.actions)
    for start in range(horizon):
        n = min(len(given), horizon - start)
        if np.array_equal(given[:n], previous.actions[start : start + n]) and not given[n:].any():
            rows = np.zeros((len(given), previous.normalized.shape[1]), np.float32)
            rows[:n] = previous.normalized[start : start + n]
            return rows
    raise vla_cpp.BadObservation(
        "prev_chunk_left_over", "rows of the chunk that this policy returned last", f"{len(given)} other rows",
        "reset() starts anew; a step after the policy must not change actions in real-time chunking",
    )

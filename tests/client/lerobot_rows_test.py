# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What needs no LeRobot of plugins/lerobot; the rest is tested in plugins/lerobot/tests."""

import importlib.util
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import vla_cpp

FILE = Path(__file__).resolve().parents[2] / "plugins/lerobot/lerobot_policy_vla_cpp/rows.py"
spec = importlib.util.spec_from_file_location("rows", FILE)
rows = importlib.util.module_from_spec(spec)
spec.loader.exec_module(rows)
NORMALIZED = np.arange(10, dtype=np.float32).reshape(5, 2) + 1
CHUNK = SimpleNamespace(actions=3 * NORMALIZED - 7, normalized=NORMALIZED)


@pytest.mark.parametrize("start", range(5))
@pytest.mark.parametrize("n", range(1, 8))
def test_rows_of_a_chunk_are_found_and_padded_with_zeros(start, n):
    given = np.zeros((n, 2), np.float32)
    left = CHUNK.actions[start : start + n]
    given[: len(left)] = left
    found = rows.unexecuted_rows(given, CHUNK)
    assert found.shape == given.shape
    assert np.array_equal(found[: len(left)], NORMALIZED[start : start + n]) and not found[len(left) :].any()


def test_other_rows_are_refused():
    for other in (CHUNK.actions[1:3] + 1e-3, CHUNK.actions[[1, 3]], np.ones((2, 2), np.float32)):
        with pytest.raises(vla_cpp.BadObservation, match="rows of the chunk that this policy returned last"):
            rows.unexecuted_rows(other, CHUNK)

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The check of a fuzz target, with seeds instead of time."""

import random
import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).resolve().parents[1] / "fuzz"))
from checkpoint_fuzz import NAMES, attempt  # noqa: E402


@pytest.mark.parametrize("name", NAMES[::4])
def test_a_checkpoint_with_a_damaged_file_is_refused_or_converted_and_nothing_else(tmp_path, name):
    rng = random.Random(name)
    for i in range(5):
        _, wrong = attempt(name, rng, tmp_path / str(i))
        assert not wrong

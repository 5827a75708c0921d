# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Collecting demonstrations: every report of the simulators' processes comes, and their early end is told."""

import numpy as np
import pytest
from vla_cpp.eval import demonstrations


def work(numbers, done):
    for number in numbers:
        done.put(number)
    demonstrations.leave(done)


def test_every_report_comes_and_an_early_end_is_told():
    came = demonstrations.reports(work, [([1, 2],), ([3],)], 4)
    assert sorted(next(came) for _ in range(3)) == [1, 2, 3]
    with pytest.raises(SystemExit, match="stopped early"):
        next(came)


def test_a_file_is_there_whole_or_not_at_all(tmp_path):
    class Broken:
        def __array__(self, *_, **__):
            raise OSError("full")

    demonstrations.write(str(tmp_path / "1.npz"), {"seed": 3, "state": np.ones(2)})
    with np.load(tmp_path / "1.npz") as file:
        assert (int(file["seed"]), file["state"].tolist()) == (3, [1, 1])
    with pytest.raises(OSError, match="full"):
        demonstrations.write(str(tmp_path / "2.npz"), {"state": np.ones(2), "place": Broken()})
    assert not (tmp_path / "2.npz").exists()

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""scripts/fleet_size.py: its queue beside queueing theory and beside counts that can be made by hand."""

import json
import statistics
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / "scripts"))

from fleet_size import simulate  # noqa: E402


@pytest.mark.parametrize("load", [0.3, 0.6, 0.8])
def test_waiting_is_that_of_theory_where_robots_ask_at_random(load):
    """One server, constant service, Poisson arrivals (M/D/1): Pollaczek and Khinchine's mean wait."""
    service = 0.01
    took, replaced, used = simulate(100, 100 * service / load, service, 0.0, n_act=40_000, poisson=True)
    assert replaced == 0 and used == pytest.approx(load, rel=0.03)
    assert statistics.mean(took) - service == pytest.approx(load * service / (2 * (1 - load)), rel=0.1)


def test_a_robot_alone_waits_for_nobody_and_one_that_asks_too_often_replaces_its_own_acts():
    took, replaced, _ = simulate(1, 0.1, 0.02, 0.0, network=0.005)
    assert replaced == 0 and max(took) == pytest.approx(0.025) == min(took)
    took, replaced, used = simulate(1, 0.1, 0.25, 0.0)
    assert replaced > 0.5 * len(took) and used > 0.99


def test_the_program_counts_robots_and_servers():
    def count(*options):
        command = [sys.executable, ROOT / "scripts/fleet_size.py", "--horizon", "16", "--rate", "80", "--replan", "8", *options]
        return json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)

    small = count("--service-ms", "14")
    assert 5 <= small["robots_of_a_server"] <= 7  # 100 ms have room for seven
    assert small["in_time"] >= 0.99 > small["in_time_with_one_more"]
    assert small["servers"]["100"] == -(-100 // small["robots_of_a_server"])
    assert count("--service-ms", "150")["servers"] == {"1": None, "100": None, "10000": None}

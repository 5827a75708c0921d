# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""scripts/serve_load.py, which measures the server under load, on a small load. Times are not judged: machines differ."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from server_process import VLA

pytestmark = pytest.mark.alone

ROOT = Path(__file__).resolve().parents[2]
TOOL = os.environ.get("VLA_LOAD_TOOL", VLA.with_name("load_tool"))


def measured(figure, *options):
    command = [sys.executable, ROOT / "scripts/serve_load.py", figure, "--vla", VLA, "--tool", TOOL, "--json", *options]
    result = subprocess.run([str(a) for a in command], capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
    return json.loads(result.stdout)


def test_of_2000_acts_of_8_clients_no_answer_is_lost_or_crossed_and_turns_are_fair():
    report = measured("many", "--clients", "8", "--requests", "2000")["many"]
    assert (report["answers"], report["crossed"], report["errors"], report["unasked"]) == (2000, 0, 0, 0)
    assert report["served"]["most"] <= 2 * report["served"]["least"]


def test_memory_does_not_grow_with_requests():
    report = measured("many", "--clients", "4", "--requests", "3000")
    assert len(report["many"]["resident_mb"]) == 10 and report["growth"] < 0.1, report


def test_the_overhead_is_told_for_raw_and_for_jpeg_views():
    report = measured("overhead", "--requests", "50")
    assert 0 < report["cpp"]["overhead_ms"]["p50"] <= report["cpp"]["overhead_ms"]["p99"]
    assert 0 < report["python"]["overhead_ms"]["p50"]
    assert measured("jpeg", "--requests", "50")["ratio"] > 0.5


def test_every_protocol_is_told_beside_the_native_one():
    report = measured("protocols", "--requests", "20")["protocols"]
    assert {"openpi", "gr00t"} <= set(report)

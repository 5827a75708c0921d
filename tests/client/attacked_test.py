# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""A short form of scripts/serve_attacked.py: all attacks on one or more front ends at once, beside clients that behave."""

import subprocess
import sys

import pytest
from server_process import ROOT, VLA, first_in_line

# The tests may share their two cores with anything. What an attack once cost was seconds, or hundreds of megabytes.
LOOSE = 25


@pytest.mark.parametrize("doors", ["native,metrics", "openpi,gr00t,control", "lerobot,page", "process"])
def test_a_server_under_every_attack_at_once_answers_those_who_behave_and_stays_within_its_limits(doors):
    script = [sys.executable, ROOT / "scripts/serve_attacked.py", "--vla", VLA, "--check", "--door", doors]
    script += ["--seconds", "2", "--settle", "2", "--loose", LOOSE, "--patience", "20", *first_in_line()]
    result = subprocess.run(list(map(str, script)), capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stdout + result.stderr

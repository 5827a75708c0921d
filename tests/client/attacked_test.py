# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""A short form of scripts/serve_attacked.py: every attack at once, beside clients that behave."""

import subprocess
import sys

from server_process import ROOT, VLA

# The tests may share their two cores with anything. What an attack once cost was seconds, or hundreds of megabytes.
LOOSE = 25


def test_a_server_under_every_attack_at_once_answers_those_who_behave_and_stays_within_its_limits():
    script = [sys.executable, ROOT / "scripts/serve_attacked.py", "--vla", VLA, "--seconds", "4", "--loose", str(LOOSE)]
    result = subprocess.run(list(map(str, script)), capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "**missed**" not in result.stdout and "a slow upload is answered |  | True" in result.stdout

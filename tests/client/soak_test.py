# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""A short form of scripts/soak.py, which make soak runs for as long as one likes."""

import subprocess
import sys

from server_process import ROOT, VLA, first_in_line

SECONDS = 24
LOOSE = 10  # on times: the tests may share their two cores with anything


def test_nothing_is_lost_or_grows_while_recordings_policies_and_processes_come_and_go():
    script = [sys.executable, ROOT / "scripts/soak.py", "--vla", VLA, "--seconds", SECONDS, "--every", 2, "--loose", LOOSE, "--patience", 20, *first_in_line()]
    result = subprocess.run(list(map(str, script)), capture_output=True, text=True, timeout=10 * SECONDS)
    assert result.returncode == 0 and "no bar is missed" in result.stdout, result.stdout + result.stderr

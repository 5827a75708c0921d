#!/usr/bin/env python3
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The programs that are run by hand, tools/ and scripts/, still start: each prints its help.  One whose library is not installed here
skips by name.  The case that parity_full.py makes for a family is one that the family can be asked."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / "tools"))
import parity_full  # noqa: E402
from goldens import families, family  # noqa: E402

PROGRAMS = sorted(str(file.relative_to(ROOT)) for folder in ("tools", "tools/peers", "scripts", "scripts/gpu_kit") for file in (ROOT / folder).glob("*.py"))


@pytest.mark.parametrize("program", PROGRAMS)
def test_a_program_that_is_run_by_hand_prints_its_help(program):
    done = subprocess.run([sys.executable, "-B", ROOT / program, "--help"], capture_output=True, text=True, timeout=120)
    lacking = re.search(r"^ModuleNotFoundError: No module named '(jax|torch|openvino)", done.stderr, re.M)
    if lacking:
        pytest.skip(f"{program}: no {lacking[1]} here")
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("arch", [arch for arch in families() if hasattr(family(arch), "published")])
def test_a_case_of_the_published_size_has_a_sentence_and_frames(arch, tmp_path, monkeypatch):
    monkeypatch.setattr(parity_full.cases, "write_checkpoint", lambda case, folder: 0)
    parity_full.write_case(tmp_path, arch)
    observation = json.loads((tmp_path / "observation.json").read_text())
    assert isinstance(observation["text"], str)
    assert observation["images"] and all((tmp_path / file).is_file() for file in observation["images"].values())

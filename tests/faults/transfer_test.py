# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What an act asks of a driver: one upload before it computes, one download after it, and no memory."""

import json
import subprocess
import sys
from collections import Counter

import pytest
from conftest import ROOT
from golden_cases import NAMES, Golden

READS_TOKENS_BACK = ("openvla", "pi0_fast")  # and so downloads one after the other
ONE_OF_EACH = sorted({name.split("/")[0]: name for name in NAMES if name.split("/")[0] not in READS_TOKENS_BACK}.values())

PROGRAM = f"""
import json, sys
sys.path[:0] = [{str(ROOT / "python")!r}]
import vla_cpp
bundle, images, state, text, leftover, memory, counts = json.loads(sys.argv[1])
images = {{view: file and open(file, "rb").read() for view, file in images.items()}}
with vla_cpp.Policy(bundle, device="cuda", memory=memory) as policy:
    rest = {{}}
    act = lambda: policy.act(images=images, state=state, text=text, seed=1, **rest)
    first = act()
    if leftover:
        rest["leftover"] = vla_cpp.Leftover(first.normalized[2:], **leftover)
        act()
    print("from here", file=open(counts, "a"))
    act()
    print("to here", file=open(counts, "a"))
"""


def calls_of_an_act(fake, case, leftover=None, memory=0):
    """Of one whose plan is there. Programs run once for each stage of the prefix and each step, and ggml waits for each."""
    environment = {**fake.program(counts=fake.counts).environment, "VLA_LIBRARY": str(fake.library)}
    images = {view: file and str(file) for view, file in case.images.items()}
    arguments = json.dumps([str(case.bundle), images, case.state, case.text, leftover, memory, str(fake.counts)])
    subprocess.run([sys.executable, "-c", PROGRAM, arguments], check=True, timeout=60, env=environment)
    lines = fake.counts.read_text(encoding="utf-8").splitlines()
    counts = Counter(lines[lines.index("from here") + 1 : lines.index("to here")])
    assert counts.pop("compute") >= 2 and counts.pop("synchronize") >= 2
    return counts


@pytest.mark.parametrize("name", ONE_OF_EACH)
def test_an_act_uploads_once_and_downloads_once(fake, name):
    assert calls_of_an_act(fake, Golden(name)) == {"set": 1, "get": 1}


def test_so_does_an_act_that_continues_the_last_chunk(fake, golden):
    leftover = {"delay": 1, "schedule": "linear", "max_guidance": 5.0}
    assert calls_of_an_act(fake, golden, leftover) == {"set": 1, "get": 1}

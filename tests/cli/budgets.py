# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Budgets of a device's memory under which matrices come from the file, and what acts under them must show."""

import json
import subprocess
import sys

from golden_cases import ROOT


def inspected(vla, bundle, budget, options):
    answer = vla("inspect", bundle, "--memory", str(budget), "--json", *options, limit=300)
    assert answer.code == 0, answer.err
    return json.loads(answer.out)


def budgets(vla, bundle, options):
    """The least, and one between it and what all of it takes."""
    all_there = inspected(vla, bundle, "1GB", options)
    told, total = all_there["memory_budget_bytes"], all_there["memory_bytes"]["total"]
    assert told["process"] == told["read_in_every_act"] == 0 and told["smallest"] < total
    least, middle = told["smallest"], (told["smallest"] + total) // 2
    most, less = (inspected(vla, bundle, budget, options) for budget in (least, middle))
    assert most["memory_bytes"]["total"] == least and less["memory_bytes"]["total"] <= middle
    n_read = [one["memory_budget_bytes"]["read_in_every_act"] for one in (most, less)]
    assert n_read[0] >= n_read[1] > 0
    return least, middle


CHANGING = f"""
import json, sys
sys.path[:0] = [{str(ROOT / "python")!r}]
import vla_cpp
path, images, state, text, options = json.loads(sys.argv[1])
images = {{view: file and open(file, "rb").read() for view, file in images.items()}}
stored = open(path, "rb").read()
half = len(stored) // 2
def write(data):
    with open(path, "r+b") as file:
        file.write(data)
with vla_cpp.Policy(path, **options) as policy:
    act = lambda: policy.act(images=images, state=state, text=text, seed=1).actions.tobytes()
    expected = act()
    write(stored[:half] + bytes(byte ^ 0x55 for byte in stored[half:]))
    codes = []
    for _ in range(3):
        try:
            act()
            codes.append("chunk")
        except vla_cpp.VlaError as error:
            codes.append(error.code)
    write(stored)
    print(codes[-1], [act() == expected for _ in range(3)])
"""


def check_changing_file(case, copy, environment, **options):
    """An act under a budget is refused while the file has other bytes, and those after it answer as before."""
    copy.write_bytes(case.bundle.read_bytes())
    images = {view: file and str(file) for view, file in case.images.items()}
    given = json.dumps([str(copy), images, case.state, case.text, options])
    command = [sys.executable, "-c", CHANGING, given]
    run = subprocess.run(command, capture_output=True, text=True, timeout=300, env=environment)
    assert run.returncode == 0, run.stderr
    assert run.stdout.strip() == "bad_bundle [True, True, True]"

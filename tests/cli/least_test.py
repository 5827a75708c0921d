# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The least memory that --memory tells for policies of published sizes: with it they load, and with less they are refused.

Nothing is computed, and weights are holes in a file. Some families in every dtype, each with one set of kernels; with VLA_ALL_BUDGETS
all families and kernels.
"""

import json
import os
import re
import subprocess
from contextlib import contextmanager
from pathlib import Path

import pytest
from memory_test import PROCESSES_DIFFER, SHIPPED, told
from program import EXIT, IS_SANITIZED

MB = 10**6
STORED = ("bf16", "f32", "int8", "int4")
SMALL = ("act", "smolvla", "turbovla", "xvla")
IS_ALL = "VLA_ALL_BUDGETS" in os.environ


@contextmanager
def published(vla, *policy):
    """The tool's first line for an architecture and dtype: the path of a bundle. Without them all lines: the architectures."""
    tool = os.environ.get("VLA_PUBLISHED_TOOL", Path(vla.path).with_name("published_tool"))
    with subprocess.Popen([tool, *policy], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        yield process.stdout.readline().strip() if policy else process.stdout.read().split()


@pytest.fixture(scope="module")
def kernels(vla):
    """What this machine can run with a budget."""
    known = re.search("expected (.*), found", vla("inspect", SHIPPED, "--kernels", "x").err)[1]
    names = [name for name in re.split(", | or ", known) if name != "ggml"]
    return [name for name in names if vla("inspect", SHIPPED, "--kernels", name).code == 0]


@pytest.fixture(scope="module")
def families(vla):
    with published(vla) as names:
        assert set(SMALL) < set(names)
    return names if IS_ALL else SMALL


def check_least(ask):
    smallest = told(ask("1"))
    enough = ask(f"{smallest}MB")
    assert enough.code == 0, enough.err
    memory, budget = (json.loads(enough.out)[key] for key in ("memory_bytes", "memory_budget_bytes"))
    assert budget["size"] == smallest * MB
    assert budget["process"] + memory["total"] <= budget["size"]
    less = told(ask(f"{smallest - 2 * PROCESSES_DIFFER}MB"))
    assert abs(less - smallest) <= PROCESSES_DIFFER


def check_policy(vla, arch, stored, kernels):
    with published(vla, arch, stored) as path:
        for name in kernels:
            command = ("inspect", path, "--kernels", name, "--json")
            if vla(*command).code == EXIT["unsupported"]:  # nothing is left to round
                continue
            print(f"{arch} in {stored}, kernels {name}")
            check_least(lambda budget, command=command: vla(*command, "--memory", budget))


@pytest.mark.skipif(IS_SANITIZED, reason="a sanitizer takes more memory than some policies, and never the same")
@pytest.mark.parametrize("stored", STORED)
def test_a_published_policy_loads_with_the_least_that_is_told_and_is_refused_with_less(vla, families, kernels, stored):
    for i, arch in enumerate(families, start=len(families) * STORED.index(stored)):
        check_policy(vla, arch, stored, kernels if IS_ALL else [kernels[i % len(kernels)]])

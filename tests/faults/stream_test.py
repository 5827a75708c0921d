# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""--memory on a backend of ggml: what does not fit comes through windows. The driver computes as late as it may, so that a window that
is filled before it was read shows, or at once, so that a matrix that is not there yet does."""

import re
import subprocess
import sys

import pytest
from budgets import budgets, check_changing_file
from conftest import DEVICE, ROOT
from fault_test import LOST, position
from golden_cases import Golden
from program import EXIT
from transfer_test import calls_of_an_act

STREAMED = ["smolvla/sparse_expert", "gr00t_n1_6/faint"]
SHIPPED = ROOT / "models/metaworld-tiny.gguf"
FRAME = ROOT / "examples/metaworld/episodes/faucet-open/step_00.png"
SEEN = ["--image", f"corner4={FRAME}", "--state", "0.0045,0.4003,0.1957,1", "--text", "open the faucet", "--json"]


@pytest.fixture
def case():
    return Golden(STREAMED[0])


def check_same_answers(fake, bundle, arguments):
    expected = fake.program()(*arguments).json()["actions"]
    for budget in budgets(fake.program(), bundle, DEVICE):
        for settings in ({}, {"at_once": "yes"}):
            answer = fake.program(**settings)(*arguments, "--memory", str(budget))
            assert answer.json()["actions"] == expected, (budget, settings)


@pytest.mark.parametrize("name", STREAMED)
def test_an_act_within_a_budget_of_device_memory_answers_the_same_bytes(fake, name):
    case = Golden(name)
    check_same_answers(fake, case.bundle, case.arguments(options=["--json", *DEVICE]))


@pytest.mark.parametrize("kernels", [[], ["--kernels", "bf16"]])
def test_so_does_a_policy_with_rounded_matrices(fake, kernels):
    check_same_answers(fake, SHIPPED, ["run", SHIPPED, *SEEN, "--seed", "1", *DEVICE, *kernels])


@pytest.mark.parametrize("code", ["int8", "int4"])
def test_so_does_a_quantized_one(fake, code, tmp_path):
    quantized = tmp_path / "quantized.gguf"
    assert fake.program()("quantize", SHIPPED, "-o", quantized, "--dtype", code).code == 0
    check_same_answers(fake, quantized, ["run", quantized, *SEEN, "--seed", "1", *DEVICE])


def test_a_budget_that_is_too_small_is_refused_before_anything_is_taken(fake, case):
    least, _ = budgets(fake.program(), case.bundle, DEVICE)
    answer = fake.program(counts=fake.counts)(*case.arguments(options=[*DEVICE, "--memory", str(least - 1)]))
    answer.refused("out_of_memory", "memory", f"expected {-(-least // 1_000_000)} MB or more")
    assert "allocate" not in fake.counts.read_text(encoding="utf-8")


OPEN = f"""
import sys
sys.path[:0] = [{str(ROOT / "python")!r}]
import vla_cpp
try:
    vla_cpp.Policy(sys.argv[1], device="cuda", memory=int(sys.argv[2])).close()
    print("opened")
except vla_cpp.VlaError as error:
    print(error.code)
"""


def test_what_a_policy_takes_of_the_device_is_its_budget_to_the_byte(fake, case):
    def opened(budget, memory):
        environment = {**fake.program(memory=memory).environment, "VLA_LIBRARY": str(fake.library)}
        command = [sys.executable, "-c", OPEN, str(case.bundle), str(budget)]
        return subprocess.run(command, stdout=subprocess.PIPE, text=True, timeout=60, env=environment).stdout.strip()

    least, _ = budgets(fake.program(), case.bundle, DEVICE)
    assert opened(least, least) == "opened"
    assert opened(least, least - 1) == "out_of_memory"


def test_an_act_uploads_each_group_once_and_takes_no_memory(fake, case):
    least, _ = budgets(fake.program(), case.bundle, DEVICE)
    counts = calls_of_an_act(fake, case, memory=least)
    n_group = counts["wait"]
    assert n_group > 3
    assert counts.pop("record") >= n_group
    assert counts == {"set": 1 + n_group, "wait": n_group, "get": 1}


def test_a_file_that_changes_is_refused_and_the_policy_acts_again_where_its_bytes_are_back(fake, case, tmp_path):
    least, _ = budgets(fake.program(), case.bundle, DEVICE)
    environment = {**fake.program().environment, "VLA_LIBRARY": str(fake.library)}
    check_changing_file(case, tmp_path / "policy.gguf", environment, device="cuda", memory=least)


@pytest.mark.parametrize(
    "which", ["first record", "first wait", "last wait", "last record", "last set", "last synchronize"]
)
def test_a_call_that_fails_while_matrices_come_is_a_device_error(fake, case, which):
    least, _ = budgets(fake.program(), case.bundle, DEVICE)
    arguments = case.arguments(options=["--json", *DEVICE, "--memory", str(least)])
    calls = fake.calls(*arguments)
    calls = calls[: calls.index("get")]  # what follows gives all back
    answer = fake.program(fails_at=position(calls, which))(*arguments)
    assert answer.code == EXIT["device"] and answer.out == "", (answer.code, answer.err)
    assert re.match(r"error: device: " + LOST.format(call=which.split()[1]), answer.err), answer.err

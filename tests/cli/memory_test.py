# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""--memory: what does not fit stays in the file and is read in every act, and nothing else changes."""

import json
import re
import shutil
from itertools import product
from pathlib import Path
from types import SimpleNamespace

import pytest

import wire
from golden_cases import ROOT
from program import EXIT, IS_SANITIZED, every_third_if_sanitized
from serve_test import serve  # noqa: F401, a fixture

SHIPPED = ROOT / "models/metaworld-tiny.gguf"
PROCESSES_DIFFER = 3  # MB that the least that is told has more than this process needs
LEAST = re.compile(r"expected (\d+) MB or more, found \d+ MB")
IMAGE = sorted((ROOT / "examples/metaworld/episodes").rglob("*.png"))[0]
OBSERVATION = SimpleNamespace(images={"corner4": IMAGE}, state=[0, 0.4, 0.2, 1], text="open the faucet")


@pytest.fixture(scope="module")
def run(vla):
    def run(*options, bundle=SHIPPED):
        return vla("run", bundle, "--image", f"corner4={IMAGE}", "--state", "0,0.4,0.2,1", "--text", "open the faucet",
                   "--seed", "3", "--json", *options)  # fmt: skip

    return run


def told(answer):
    """Megabytes that the refusal of too few asks for."""
    assert answer.code == EXIT["out_of_memory"], answer.err
    return int(LEAST.search(answer.err)[1])


def least(answer):
    """Megabytes that a process of the same size needs."""
    return told(answer) - PROCESSES_DIFFER


def within(ask, more):
    """What `ask` answers with so many megabytes more than the least, which is not the same in every run: a process differs."""
    smallest = least(ask("1MB"))
    for _ in range(20):
        answer = ask(f"{smallest + more}MB")
        if answer.code == 0:
            return answer
        smallest = least(answer)
    raise AssertionError(answer.err)


def serving(vla, serve, options, more):
    """A server with so many megabytes more than the least."""
    for _ in range(20):
        budget = least(vla("serve", *options, "--memory", "1MB")) + more
        try:
            return serve(*options, "--memory", f"{budget}MB")
        except ValueError:  # no ready line
            continue
    raise AssertionError("no server within its budget")


@pytest.mark.parametrize(("threads", "kernels"), every_third_if_sanitized(product("12", ["float32", "bf16", "int8", "portable"])))
def test_actions_are_the_same_to_the_bit_within_any_budget(vla, run, kernels, threads):
    if kernels == "bf16" and "bf16" not in vla.cpu():
        pytest.skip(f"this processor multiplies no bf16: {vla.cpu()}")
    options = ("--kernels", kernels, "--threads", threads)
    expected = run(*options).json()["actions"]
    for more in (1, 2, 3, 100):
        assert within(lambda budget: run(*options, "--memory", budget), more).json()["actions"] == expected


@pytest.mark.parametrize("kernels", ["float32", "int8", "int4", "portable"])
def test_the_least_that_is_told_suffices(run, kernels):
    smallest = told(run("--kernels", kernels, "--memory", "1MB"))
    for _ in range(3):
        assert run("--kernels", kernels, "--memory", f"{smallest}MB").code == 0


def memory_of(server):
    """Bytes of a server that has answered an act, without those of its program's files."""
    assert wire.kind(wire.Peer(server.ready["address"]).ask(wire.act(1, OBSERVATION, seed=0))) == "chunk"
    status = Path(f"/proc/{server.process.pid}/status").read_text(encoding="ascii")
    return 1024 * int(re.search(r"RssAnon:\s*(\d+) kB", status)[1])


@pytest.mark.skipif(IS_SANITIZED, reason="a sanitizer takes more memory than the policy")
def test_a_budget_is_kept(vla, serve):
    options = (SHIPPED, "--bind", "tcp://127.0.0.1:0", "--kernels", "float32")
    tight, roomy = serving(vla, serve, options, 0), serve(*options)
    assert memory_of(tight) < memory_of(roomy) - 2_000_000
    assert float(tight.ready["read_mb"]) > 1 and "read_mb" not in roomy.ready


def inspected(vla, budget):
    return json.loads(vla("inspect", SHIPPED, "--memory", budget, "--json").out)


def test_inspect_tells_what_is_read_in_every_act(vla):
    roomy = inspected(vla, "1GB")["memory_budget_bytes"]
    assert roomy["size"] == 10**9 and roomy["read_in_every_act"] == 0
    tight = json.loads(within(lambda budget: vla("inspect", SHIPPED, "--memory", budget, "--json"), 2).out)
    assert 10**6 < tight["memory_budget_bytes"]["read_in_every_act"] < SHIPPED.stat().st_size
    all_of_it = tight["memory_bytes"]["total"] + tight["memory_budget_bytes"]["process"]
    smallest = tight["memory_budget_bytes"]["smallest"] - (PROCESSES_DIFFER << 20)
    assert smallest <= all_of_it <= tight["memory_budget_bytes"]["size"]
    text = within(lambda budget: vla("inspect", SHIPPED, "--memory", budget), 2).out
    assert re.search(r"budget .* MB is the least that does\n +every act reads .* of the file's 9\.2 MB", text)
    assert "all matrices stay in memory" in vla("inspect", SHIPPED, "--memory", "1GB").out
    assert "budget" not in vla("inspect", SHIPPED).out


def test_a_bench_tells_what_was_read_and_what_the_system_keeps(vla):
    def bench(*more):
        return vla("bench", SHIPPED, "--runs", "1", "--warmup", "0", "--threads", "1", *more)

    memory = within(lambda budget: bench("--json", "--memory", budget), 2).json()["memory_bytes"]
    assert 0 < memory["read_in_every_act"] <= SHIPPED.stat().st_size and memory["read_in_every_act"] <= memory["cached"]
    text = within(lambda budget: bench("--memory", budget), 2).out
    assert re.search(r"budget \d+ MB: every act reads \d+ MB of the file", text)


@pytest.mark.parametrize(
    ("given", "bytes"), [("1.5GB", 1_500_000_000), ("800M", 800_000_000), ("2GiB", 2 << 30), ("12345678901", 12_345_678_901), ("1tb", 10**12)]
)
def test_bytes_have_units(vla, given, bytes):
    assert inspected(vla, given)["memory_budget_bytes"]["size"] == bytes


@pytest.mark.parametrize("given", ["", "x", "1.5XB", "1e9", "-1GB", "0", "nan", "GB", "1 GB", "1GBs", "1BB"])
def test_what_is_no_number_of_bytes_is_refused(run, given):
    run(f"--memory={given}").refused("usage", "--memory")


def test_too_small_a_budget_is_refused_with_the_least_that_does(run):
    run("--memory", "1MB").refused("out_of_memory", "memory", "MB or more, found 1 MB; give more", "vla quantize")


def test_kernels_that_keep_all_weights_refuse_a_budget(run):
    run("--kernels", "ggml", "--memory", "1GB").refused("unsupported", "memory", "leave the budget out")


def test_a_bundle_that_changes_while_it_is_read_is_refused_until_its_bytes_are_back(vla, serve, tmp_path):
    """Matrices stay in the file: the act that finds others there is an error, and the server goes on."""
    path = tmp_path / "policy.gguf"
    shutil.copy(SHIPPED, path)
    stored = path.read_bytes()
    options = (path, "--bind", "tcp://127.0.0.1:0", "--threads", "1", "--kernels", "float32")
    server = serving(vla, serve, options, 2)
    peer = wire.Peer(server.ready["address"])
    before = [wire.actions(peer.ask(wire.act(1, OBSERVATION, seed=seed))) for seed in range(3)]
    half = len(stored) // 2
    with open(path, "r+b") as file:
        file.seek(half)
        file.write(bytes(byte ^ 0x55 for byte in stored[half:]))
    answers = [peer.ask(wire.act(2, OBSERVATION, seed=0)) for _ in range(3)]
    assert wire.kind(answers[-1]) == "error" and b"renaming a new file over it" in answers[-1]
    assert server.process.poll() is None
    path.write_bytes(stored)
    assert [wire.actions(peer.ask(wire.act(1, OBSERVATION, seed=seed))) for seed in range(3)] == before

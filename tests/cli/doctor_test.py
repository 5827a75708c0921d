# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""vla doctor: what a person and a script learn of machine, build and policy, and what its exit code says."""

import json
import os
import re
import struct

import pytest
from conftest import ROOT
from golden_cases import sealed
from program import IS_SANITIZED

DEMO = ROOT / "models/metaworld-tiny.gguf"
LATE = 16


@pytest.fixture(scope="module")
def report(vla):
    answer = vla("doctor", DEMO, "--json")
    is_late = "error: late: " in answer.err  # on a busy machine, or under a sanitizer
    assert answer.code == (LATE if is_late else 0), answer.err
    return json.loads(answer.out)


@pytest.fixture
def timed(vla):
    """The program. Skips under a sanitizer, which measures itself."""
    if IS_SANITIZED:
        pytest.skip("a sanitizer slows the kernels down")
    return vla


def test_the_machine_and_the_build_are_told_without_a_bundle(vla):
    answer = vla("doctor")
    assert answer.code == 0
    for word in ("machine", "cores", "peaks", "GB/s", "memory", "governor", "load", "build", "device"):
        assert word in answer.out, word


def test_json_has_machine_build_and_policy(report):
    machine, policy = report["machine"], report["policy"]
    assert machine["cores"] == len(os.sched_getaffinity(0)) and machine["bandwidth_gbytes_per_s"] > 0
    assert machine["free_memory_bytes"] > 1e8 and machine["load"] >= 0
    assert machine["devices"][0]["name"] == "cpu" and machine["kernels"][-1] in machine["devices"][0]["description"]
    assert policy["arch"] == "smolvla" and policy["horizon"] == 16 and policy["memory_bytes"] > 1e6
    assert list(policy["stages"]) == ["vision", "prefix", "steps", "network"]
    network = policy["stages"]["network"]["measured_ms"]
    assert policy["act_ms"] == pytest.approx(network + policy["host_ms"], rel=1e-3)


def test_int8_is_named_where_its_prediction_is_a_gain(timed):
    told = re.findall(r"--kernels int8: ([\d.]+) ms of the network predicted instead of ([\d.]+)", timed("doctor", DEMO, "--threads", 1).out)
    for int8, own in told:
        assert float(int8) < 0.9 * float(own) + 0.01


@pytest.mark.parametrize("kernels", ["float32", "int8"])
def test_prediction_and_measurement_agree(timed, kernels):
    """In one of five runs: what others do on the machine slows down one of the two in any of them."""
    found = []
    for _ in range(5):
        policy = timed("doctor", DEMO, "--threads", 1, "--kernels", kernels, "--json").json()["policy"]
        *stages, network = policy["stages"].values()
        assert (policy["int8_predicted_ms"] is None) == (kernels == "int8")
        assert sum(stage["predicted_ms"] for stage in stages) == pytest.approx(network["predicted_ms"])
        found.append((network["measured_ms"] * min(1, policy["cores"]), network["predicted_ms"]))  # of one core
        if found[-1][0] == pytest.approx(found[-1][1], rel=0.4):
            return
    pytest.fail("measured and predicted, ms: {}".format(found))


def test_an_act_of_a_few_milliseconds_is_measured_on_one_thread_too(timed, report):
    policy = report["policy"]
    assert ("one_thread_act_ms" in policy) == (policy["threads"] > 1 and policy["act_ms"] < 250)
    answer = timed("doctor", DEMO, "--threads", 1)
    is_late = "the rate is not held" in answer.out  # on a busy machine
    assert answer.code == (LATE if is_late else 0) and "predicted ms  measured ms" in answer.out and "replan every" in answer.out
    assert answer.out.count("\n") <= 40


def test_what_is_refused_is_told_after_the_machine(vla, tmp_path):
    (tmp_path / "bad.gguf").write_bytes(b"GGUF")
    answer = vla("doctor", tmp_path / "bad.gguf")
    assert answer.code == 3 and "machine" in answer.out and "error: bad_bundle" in answer.err
    answer = vla("doctor", tmp_path / "bad.gguf", "--json")
    assert answer.code == 3 and json.loads(answer.out)["refused"]["code"] == "bad_bundle"
    assert vla("doctor", DEMO, "--device", "cuda:77").code == 8


def test_a_chunk_that_ends_before_the_next_is_there_has_its_exit_code(timed, tmp_path):
    data = bytearray(DEMO.read_bytes())
    at = data.index(b"action.rate_hz") + len("action.rate_hz")
    kind, rate = struct.unpack_from("<If", data, at)
    assert (kind, rate) == (6, 80)  # float32
    struct.pack_into("<f", data, at + 4, 1e5)
    (tmp_path / "fast.gguf").write_bytes(sealed(bytes(data)))
    answer = timed("doctor", tmp_path / "fast.gguf", "--threads", 1)
    assert answer.code == LATE and "the rate is not held" in answer.out and "error: late" in answer.err

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Our own kernels for CUDA at the program's doors, on a driver that counts, refuses and fails (tests/cuda/library/libcuda.cpp)."""

import json
import re

import numpy as np
import pytest
from conftest import FAKE
from golden_cases import FLOAT32, NAMES, ROOT, Golden, tensors
from gpu_test import serve_until_lost, with_environment
from program import EXIT

pytestmark = pytest.mark.skipif(not FAKE, reason="no driver of tests: VLA_FAKE_CUDA")
DEVICE = ["--device", "cuda"]
IN_FLOAT32 = [*DEVICE, *FLOAT32]
FAMILIES = sorted({Golden(name).arch for name in NAMES})


METAWORLD = ROOT / "models/metaworld-tiny.gguf"


def act(vla, bundle, *options):
    """The answer of a policy for MetaWorld to one recorded look."""
    frame = ROOT / "examples/metaworld/episodes/faucet-open/step_00.png"
    seen = ["--image", f"corner4={frame}", "--state", "0.0045,0.4003,0.1957,1", "--text", "open the faucet", "--seed", "1", "--json"]
    return vla("run", bundle, *seen, *options, limit=300).json()


@pytest.mark.parametrize("codes", ["int8", "int4"])
def test_with_codes_an_answer_is_nearer_to_that_of_the_cpus_codes_than_to_float32(vla, codes):
    """The same codes of the same matrices; what lies between products is rounded in other places."""
    gpu = act(vla, METAWORLD, *DEVICE, "--kernels", codes)
    assert gpu["precision"] == "int8"
    cpu, exact = (np.array(act(vla, METAWORLD, *options)["actions"]) for options in (["--kernels", codes], FLOAT32))
    assert 0 < np.abs(np.array(gpu["actions"]) - cpu).max() < np.abs(cpu - exact).max()


def test_stored_int4_codes_act_as_those_made_at_load_and_take_their_memory(vla, tmp_path):
    small = tmp_path / "int4.gguf"
    assert vla("quantize", METAWORLD, "-o", small, "--dtype", "int4").code == 0
    made, stored = act(vla, METAWORLD, *DEVICE, "--kernels", "int4"), act(vla, small, *DEVICE)
    assert stored["actions"] == made["actions"]
    told = vla("inspect", small, *DEVICE).out
    assert "linear_int4 (" in told and "linear_int8" not in told
    weights = {bundle: json.loads(vla("inspect", bundle, *DEVICE, "--json").out)["memory_bytes"]["weights"] for bundle in (METAWORLD, small)}
    assert weights[small] < 0.45 * weights[METAWORLD]


def test_convolutions_of_int8_have_the_cpus_codes(vla, tmp_path):
    if "bf16" not in vla.cpu():
        pytest.skip(f"matrices that stay floats are multiplied in float32 here, in bf16 on the GPU: {vla.cpu()}")
    case, got, made = Golden("act/environment"), tmp_path / "got.gguf", {}
    for options in ("", "--device cuda"):
        chosen = [*options.split(), "--kernels", "int8", "--tap", "vision.blk.2", "--taps-out", got]
        assert vla(*case.arguments(options=["--json", *chosen]), limit=300).json()["precision"] == "int8"
        made[options] = tensors(got)["vision.blk.2"]  # further on a sum in another order may become another code
    cpu, gpu = made.values()
    assert np.abs(gpu - cpu).max() < 1e-5 < 1e-3 < np.abs(cpu - tensors(case.expected)["vision.blk.2"]).max()


def test_heads_that_nothing_turns_are_rounded_as_their_product_is_stored(vla):
    graph = vla("inspect", Golden("xvla/two_views").bundle, *DEVICE, "--kernels", "bf16", "--graph", "step").out
    lines = [line for line in graph.splitlines() if "transformer.blk.0.attn_" in line]
    made = {line.split("transformer.blk.0.attn_")[1][0]: line.split(" -> ")[1] for line in lines if "linear" in line}
    assert all(made[one].startswith("bf16[") for one in "qkv"), lines
    assert "attention_bf16" in next(line for line in lines if "attn_heads" in line)
    assert "heads  f32" not in graph


@pytest.mark.parametrize("case", ["smolvla/absent_view", "pi0/absent_view"])
def test_products_of_a_step_rotate_their_heads(vla, case):
    graph = vla("inspect", Golden(case).bundle, *DEVICE, "--kernels", "bf16", "--graph", "step").out
    products = [line for line in graph.splitlines() if re.search(r"\.attn_[qk], rope ", line)]
    assert products and all(" -> bf16[" in line for line in products), graph
    assert "rope heads" not in graph


def test_kernels_that_a_build_lacks_are_refused_by_the_library_that_has_them(vla, golden):
    answer = vla(*golden.arguments(options=[*DEVICE, "--kernels", "ggml"]))
    answer.refused("device", "cuda:0: expected one of cpu", "no libvla-cuda-ggml.so in ")


def test_too_little_memory_an_old_driver_and_an_old_gpu_are_refused(vla, golden):
    arguments = golden.arguments(options=IN_FLOAT32)
    with_environment(vla, VLA_FAKE_MEMORY="100000")(*arguments).refused(
        "out_of_memory", "weights: expected ", " bytes of device memory, found 100000 free"
    )
    with_environment(vla, VLA_FAKE_VERSION="12020")(*arguments).refused("device", "found one for CUDA 12.2")
    with_environment(vla, VLA_FAKE_CAPABILITY="75")(*arguments).refused("device", "expected compute capability 8.0", "found 7.5")


def test_a_device_that_is_lost_is_the_error_device_and_a_server_ends_with_it(vla, golden, tmp_path):
    counts = tmp_path / "calls"
    arguments = golden.arguments(options=IN_FLOAT32)
    assert with_environment(vla, VLA_FAKE_COUNTS=str(counts))(*arguments).code == 0
    calls = counts.read_text().split()
    launch = 1 + len(calls) - 1 - calls[::-1].index("cuGraphLaunch")
    for at in (1 + calls.index("cuMemAlloc_v2"), 1 + calls.index("cuMemcpyHtoDAsync_v2"), launch):
        lost = with_environment(vla, VLA_FAKE_FAILS_AT=str(at), VLA_FAKE_LOST="1")
        answer = lost(*arguments)
        assert answer.code == EXIT["device"] and "CUDA_ERROR_LAUNCH_FAILED" in answer.err, answer.err
    server = with_environment(vla, VLA_FAKE_FAILS_AT=str(len(calls) + 40), VLA_FAKE_LOST="1")  # in a later act
    serve_until_lost(server, golden, IN_FLOAT32, "CUDA_ERROR_LAUNCH_FAILED", 20, 60, seed=1)


def test_sizes_are_told_without_memory(vla, golden):
    small = with_environment(vla, VLA_FAKE_MEMORY="1000")
    assert small("inspect", golden.bundle, "--json", *IN_FLOAT32).code == 0


@pytest.mark.parametrize("family", FAMILIES)
def test_a_family_of_its_published_size_has_kernels_and_a_prediction(vla, family):
    """Nothing is there but counts: every operation has a kernel for its sizes."""
    seconds = []
    for model in ("orin-agx", "h100"):
        answer = vla("bench", "--arch", family, "--size", "full", *DEVICE, "--model", model, "--json")
        told = answer.json()
        stages = dict(told["stages"])
        total = stages.pop("total")
        assert told["prediction"] is True and list(stages)[-2:] == ["prefix", "steps"]
        assert total["ms"] == pytest.approx(sum(stage["ms"] for stage in stages.values()))
        assert all(stage["ms"] >= max(stage["products_ms"], stage["memory_ms"]) / 1.001 for stage in stages.values())
        seconds.append(total["ms"])
    assert seconds[0] > seconds[1] > 0.1


def test_a_prediction_is_called_one_and_takes_no_option_of_a_measurement(vla):
    arguments = ["bench", "--arch", "smolvla", "--size", "full", *DEVICE, "--model"]
    assert vla(*arguments, "h100").out.startswith("prediction, not a measurement: smolvla on a model of H100")
    vla(*arguments, "tpu").refused("usage", "expected one of orin-agx, rtx-3060, rtx-5090, h100, h200, found tpu")
    vla(*arguments, "h100", "--markdown").refused("usage", "--model")
    vla("bench", "--arch", "smolvla", "--size", "full", "--model", "h100").refused("usage", "model: expected device cuda")
    assert json.loads(vla(*arguments, "h100", "--steps", "5", "--json").out)["n_step"] == 5

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""`vla quantize --judge` and `--calibrate`: codes chosen, and channels divided, by the acts of a recording."""

import re
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from bundle_keys import bundle_keys
from server_process import ROOT, SECONDS, VLA, Server

import vla_cpp
from vla_cpp.convert.bundle import BundleWriter, TensorInfo, read_bundle

SHIPPED = SimpleNamespace(bundle=ROOT / "models/metaworld-tiny.gguf")
SCENES = [("faucet-open", "open the faucet"), ("drawer-close", "close the drawer")]


def scene(name, text, step=0):
    frame = (ROOT / f"examples/metaworld/episodes/{name}/step_{step:02}.png").read_bytes()
    return dict(images={"corner4": frame}, state=[0.0045, 0.4003, 0.1957, 1], text=text, seed=7)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recorded") / "acts"
    server = Server(SHIPPED, "--record", folder)
    with vla_cpp.Client(server.address, timeout=SECONDS) as robot:
        for name, text in SCENES:
            robot.act(**scene(name, text))
        with pytest.raises(vla_cpp.BadObservation):
            robot.act(**{**scene(*SCENES[0]), "text": None})
    assert server.stop() == 0
    return folder


def quantize(*arguments, bundle=SHIPPED.bundle):
    return subprocess.run([VLA, "quantize", bundle, *map(str, arguments)], capture_output=True, text=True, timeout=300)


def chunks(bundle, kernels=None, step=0):
    with vla_cpp.Policy(bundle, kernels=kernels, threads=1) as policy:
        return np.array([policy.act(**scene(*s, step)).normalized for s in SCENES])


def moved(bundle, kernels=None, step=0):
    """Of float32's chunks of the shipped policy, by root mean square."""
    expected = chunks(SHIPPED.bundle, "float32", step)
    return np.sqrt(np.mean((chunks(bundle, kernels, step) - expected) ** 2) / np.mean(expected**2))


def test_blocks_get_the_codes_that_keep_the_error(recording, tmp_path):
    out = tmp_path / "small.gguf"
    answer = quantize("-o", out, "--judge", recording, "--error", 0.025, "--threads", 1)
    assert answer.returncode == 0, answer.stderr
    blocks = dict(re.findall(r"^(\S*blk\S*) +(int4|int8|as stored) ", answer.stdout, re.M))
    assert {"int4", "int8"} <= set(blocks.values()) and len(blocks) == 11
    before, content = read_bundle(str(SHIPPED.bundle)), read_bundle(str(out))
    for name, dtype in content.dtypes.items():
        block = ".".join(name.split(".")[:3])
        if dtype == "i8" and block in blocks:
            width = before.tensors[name].shape[1]
            is_packed = content.tensors[name].shape[1] != width
            assert is_packed == (blocks[block] == "int4"), name
    told = re.search(r"chunks of 2 observations move by ([\d.]+) %.*all int8: ([\d.]+) %.*all int4: ([\d.]+) %", answer.stdout)
    error, int8, int4 = (float(number) / 100 for number in told.groups())
    assert error <= 0.025 < int4 and int8 < int4
    assert re.search(r"^a guide: .* solves 183 of 200 episodes in both, and 182 in float32; ", answer.stdout, re.M)
    assert moved(out) == pytest.approx(error, rel=0.01)
    assert "error at most 0.025: " in subprocess.run([VLA, "inspect", out], capture_output=True, text=True).stdout
    assert sorted(path.name for path in tmp_path.iterdir()) == ["small.gguf"]


def test_what_cannot_be_is_refused_with_what_can(recording, tmp_path):
    out = tmp_path / "small.gguf"
    answer = quantize("-o", out, "--judge", recording, "--size", "2.5MB")
    assert answer.returncode == 6 and re.search(r"--size: expected \d+ bytes or more, found 2500000", answer.stderr), answer
    answer = quantize("-o", out, "--judge", recording)
    assert answer.returncode == 2 and "expected --error or --size, found neither" in answer.stderr
    assert quantize("-o", out, "--error", 0.1).returncode == 2
    assert quantize("-o", out, "--judge", recording, "--error", 0.1, "--size", "5MB").returncode == 2
    assert quantize("-o", out, "--judge", tmp_path, "--error", 0.1).returncode != 0
    assert not list(tmp_path.iterdir())


def test_a_recording_of_another_policy_is_refused(case, tmp_path):
    server = Server(case, "--record", tmp_path / "acts")
    with vla_cpp.Client(server.address, timeout=SECONDS) as robot:
        robot.act(images={v: f.read_bytes() for v, f in case.images.items()}, state=case.state, text=case.text, seed=1)
    assert server.stop() == 0
    answer = quantize("-o", tmp_path / "small.gguf", "--judge", tmp_path / "acts", "--error", 0.1)
    assert "error: bad_request: " in answer.stderr and "expected acts of this policy, found " in answer.stderr, answer


def planted(path, factors=(32, 64), every=23):
    """The shipped policy as a trained language model is: a few channels of what matrices read are far larger than the others. The
    function is the same, since columns of the matrices are smaller by what channels are larger: powers of two change no digit."""
    content = read_bundle(str(SHIPPED.bundle))
    floats = {n: (v.astype(np.uint32) << 16).view(np.float32) if content.dtypes[n] == "bf16" else v.copy() for n, v in content.tensors.items()}

    def channels(d):
        by = np.ones(d, np.float32)
        by[::every] = np.resize(np.array(factors, np.float32), len(by[::every]))
        return by

    for name in [name for name in floats if name.endswith("norm.weight") and ".blk." in name]:
        block, by = name[: name.rindex(".", 0, -len(".weight"))], channels(len(floats[name]))
        readers = ("attn_q", "attn_k", "attn_v") if name.endswith("attn_norm.weight") else ("ffn_gate", "ffn_up")
        for vector in (name, name.replace("weight", "bias")):
            if vector in floats:
                floats[vector] *= by
        for matrix in (floats.get(f"{block}.{reader}.weight") for reader in readers):
            if matrix is not None and matrix.shape[1] == len(by):  # of cross-attention, keys and values read something else
                matrix /= by
    for name in [name for name in floats if name.endswith("ffn_gate.weight")]:
        up, down = name.replace("gate", "up"), name.replace("gate", "down")
        by = channels(len(floats[up]))
        floats[up] *= by[:, None]
        floats[down] /= by
    tensors = [TensorInfo(name, values.shape, content.dtypes[name]) for name, values in content.tensors.items()]
    with BundleWriter(str(path), bundle_keys(SHIPPED.bundle), tensors) as out:
        for name, values in floats.items():
            bits = values.view(np.uint32)
            out.write(name, (bits >> 16).astype(np.uint16) if content.dtypes[name] == "bf16" else values)
    return path


def test_channels_that_are_far_larger_than_the_others_are_smoothed(recording, tmp_path):
    outliers = planted(tmp_path / "planted.gguf")
    assert np.array_equal(chunks(outliers, "float32"), chunks(SHIPPED.bundle, "float32")), "the planted policy computes something else"

    def error(name, *options):
        answer = quantize("-o", tmp_path / name, *options, bundle=outliers)
        assert answer.returncode == 0, answer.stderr
        return moved(tmp_path / name), answer.stdout

    rough, _ = error("rough.gguf")
    smooth, told = error("smooth.gguf", "--calibrate", recording)
    int8 = moved(SHIPPED.bundle, "int8")  # without outliers
    assert rough > 3 * smooth, (rough, smooth)
    assert smooth < 1.5 * int8, (smooth, int8)
    assert re.match(r"smoothed over 2 observations: \d+ channels of \d+ of \d+ norms and MLPs divided, by \d+ at most; int8 moves chunks of 2 of them by ", told)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["planted.gguf", "rough.gguf", "smooth.gguf"]
    assert "smoothed over 2 observations" in read_bundle(str(tmp_path / "smooth.gguf")).keys["vla.quantization"]


@pytest.mark.parametrize("dtype, share", [("int8", 0.8), ("int4", 0.5)])
def test_calibrated_codes_move_chunks_less(recording, tmp_path, dtype, share):
    """Judged by acts that were not calibrated by: the same scenes some steps later."""
    plain, made = tmp_path / "plain.gguf", tmp_path / "made.gguf"
    assert quantize("-o", plain, "--dtype", dtype).returncode == 0
    answer = quantize("-o", made, "--dtype", dtype, "--calibrate", recording, "--threads", 1)
    assert answer.returncode == 0, answer.stderr
    told = re.search(rf"^(not )?rounded by Hessians over 2 observations: errors of (\d+) of (\d+) matrices made good by later columns \(GPTQ\); {dtype} moves", answer.stdout, re.M)
    assert told and int(told[2]) > 0.9 * int(told[3])
    assert ("rounded by Hessians" in read_bundle(str(made)).keys["vla.quantization"]) == (told[1] is None)
    assert told[1] is None or dtype == "int8"  # whose errors are mostly those of activations
    rotated = re.search(r"^(not )?rotated over 2 observations: channels of (.*); int. moves chunks of 2 of them by (.*) % instead of (.*) %$", answer.stdout, re.M)
    after, before = float(rotated[3]), float(rotated[4])
    assert after == before if rotated[1] else after < 0.95 * before + 0.001
    assert ("; rotated over" in "; " + read_bundle(str(made)).keys["vla.quantization"]) == (rotated[1] is None)
    if rotated[1]:
        assert rotated[2] == "expert, heads, lm, vision"
    assert plain.stat().st_size == pytest.approx(made.stat().st_size, abs=1024)

    def error(bundle):
        return np.sqrt(sum(moved(bundle, step=step) ** 2 for step in (2, 4, 6)))

    assert error(made) < share * error(plain)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["made.gguf", "plain.gguf"]


def test_a_search_takes_int4_by_hessians(recording, tmp_path):
    def size(name, *options):
        answer = quantize("-o", tmp_path / name, *options, "--judge", recording, "--error", 0.02, "--threads", 1)
        assert answer.returncode == 0, answer.stderr
        return (tmp_path / name).stat().st_size, answer.stdout

    (rough, _), (fine, told) = size("rough.gguf"), size("fine.gguf", "--calibrate", recording)
    assert fine < rough, (fine, rough)
    assert moved(tmp_path / "fine.gguf") < 0.0205
    assert "rounded by Hessians" in told


# What a budget saves at least: observations and second moments of a calibration; a search alone has little beside a policy.
@pytest.mark.parametrize(
    ("what", "saves"), [(["--calibrate"], 10e6), (["--dtype", "int4", "--calibrate"], 10e6), (["--error", 0.025, "--judge"], 0)]
)
def test_a_budget_changes_no_byte_and_is_kept(recording, tmp_path, what, saves):
    def made(name, *memory):
        return peak_of("quantize", SHIPPED.bundle, "-o", tmp_path / name, "--threads", 1, *what, recording, *memory)

    roomy, _ = made("roomy.gguf")
    _, refused = made("none.gguf", "--memory", "1MB")
    for _ in range(20):  # what is told has 3 MB more than this process needs, since processes differ
        told = int(re.fullmatch(r"error: out_of_memory: memory: expected (\d+) MB or more, found \d+ MB; .*\n", refused)[1])
        tight, refused = made("tight.gguf", "--memory", f"{told - 3}MB")
        if not refused:
            break
    assert not refused
    assert tight < roomy - saves or b"__asan_init" in VLA.read_bytes()  # a sanitizer takes more than the policy
    assert (tmp_path / "tight.gguf").read_bytes() == (tmp_path / "roomy.gguf").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["roomy.gguf", "tight.gguf"]


def peak_of(*arguments):
    """The most bytes that a call took, and what it said was wrong. Between this process and the call stands a small one, since the
    system counts the memory of the parent as well, until the program is there."""
    small = "import resource, subprocess, sys; subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL); print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)"
    answer = subprocess.run([sys.executable, "-c", small, VLA, *map(str, arguments)], capture_output=True, text=True, timeout=300)
    return 1024 * int(answer.stdout), answer.stderr

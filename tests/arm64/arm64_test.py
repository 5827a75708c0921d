# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The program for 64-bit ARM under an emulator, beside that of this machine, which must be x86-64.

The emulator is a hundred times slower than a machine and shows nothing of time or of the order in which cores see memory.
"""

import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "tests/cli"), str(ROOT / "python")]

from golden_cases import NAMES, Golden  # noqa: E402

import vla_cpp  # noqa: E402

HERE, ARM, EMULATOR = os.environ["VLA_BINARY_HERE"], os.environ["VLA_BINARY"], shlex.split(os.environ["VLA_EMULATOR"])
# A processor of robots' boards, and one with everything that the emulator knows.
PROCESSORS = ["cortex-a76", "max"]
SHORT = ["smolvla/two_views", "bitvla/one_view", "pi0/two_views"]


def run(*command, cpu="max"):
    answer = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "QEMU_CPU": cpu})
    assert answer.returncode == 0, answer.stderr
    return answer.stdout


def taps(path, name, *options, emulated=True, cpu="max", n_thread=None):
    """The file of all taps that a golden case leaves at a path."""
    arguments = Golden(name).arguments(options=["--tap", "*", "--taps-out", path, *options])
    if n_thread is not None:
        arguments[arguments.index("--threads") + 1] = str(n_thread)
    run(*([*EMULATOR, ARM] if emulated else [HERE]), *arguments, cpu=cpu)
    return path


@pytest.mark.parametrize("cpu", PROCESSORS)
@pytest.mark.parametrize("name", NAMES)
def test_every_tap_of_every_golden_case_matches_the_reference(name, cpu, tmp_path):
    made = taps(tmp_path / "taps.gguf", name, "--kernels", "neon", cpu=cpu)
    run(HERE, "compare", Golden(name).expected, made, "--tolerance", "1e-5")


@pytest.mark.parametrize("name", NAMES)
def test_every_tap_with_ggml_kernels_matches_the_reference(name, tmp_path):
    made = taps(tmp_path / "taps.gguf", name, "--kernels", "ggml", cpu="cortex-a76")
    run(HERE, "compare", Golden(name).expected, made, "--tolerance", "1e-5")


@pytest.mark.parametrize("name", SHORT)
def test_any_number_of_threads_gives_the_same_bytes(name, tmp_path):
    made = [taps(tmp_path / f"{n}.gguf", name, "--kernels", "neon", n_thread=n).read_bytes() for n in (1, 2, 4)]
    assert made[0] == made[1] == made[2]


@pytest.mark.parametrize("kernels", ["bf16", "int8", "int4"])
def test_quantized_the_shipped_policy_acts_alike_on_any_number_of_threads_and_nearly_so_on_another_machine(kernels):
    image = next((ROOT / "examples/metaworld/episodes").rglob("*.png"))
    observation = ["--image", f"corner4={image}", "--state", "0,0.4,0.2,1", "--text", "open the faucet", "--seed", "3", "--json"]
    act = ["run", ROOT / "models/metaworld-tiny.gguf", *observation, "--kernels"]
    one, two = (json.loads(run(*EMULATOR, ARM, *act, kernels, "--threads", str(n)))["actions"] for n in (1, 2))
    assert one == two
    here = json.loads(run(HERE, *act, "float32" if kernels == "bf16" else kernels))["actions"]  # not all machines have bf16
    # The sums are whole numbers and equal; a norm's last bit may still move a row's code by one.
    assert np.abs(np.array(one) - here).max() < 2e-2


@pytest.mark.parametrize("name", NAMES)
def test_portable_kernels_give_the_bytes_of_another_machine(name, tmp_path):
    """Pixels, tokens, positions and everything that is computed from them."""
    options = ["--kernels", "portable"]
    here = taps(tmp_path / "here.gguf", name, *options, emulated=False).read_bytes()
    assert taps(tmp_path / "arm.gguf", name, *options).read_bytes() == here


def test_the_c_interface_gives_the_chunk_of_the_program(tmp_path):
    case, act = Golden("smolvla/two_views"), tmp_path / "act"
    library = Path(os.environ["VLA_LIBRARY"])
    (tmp_path / "libvla.so").symlink_to(library)
    sysroot = EMULATOR[EMULATOR.index("-L") + 1]
    source = [f"-I{ROOT / 'include'}", ROOT / "examples/c/act.c", f"-L{tmp_path}", "-lvla", f"-Wl,-rpath,{library.parent}"]
    run("aarch64-linux-gnu-gcc", "-std=c99", f"--sysroot={sysroot}", *source, "-o", act)
    images = [f"{view}={file or ''}" for view, file in case.images.items()]
    told = run(*EMULATOR, act, case.bundle, case.text, ",".join(map(str, case.state)), "3", *images)
    got = np.array([line.split() for line in told.splitlines()], np.float32)
    arguments = case.arguments(options=["--seed", "3", "--json"])
    at = arguments.index("--noise")
    assert np.array_equal(got, np.float32(json.loads(run(*EMULATOR, ARM, *arguments[:at], *arguments[at + 2 :]))["actions"]))


def test_a_client_on_this_machine_is_answered_by_the_server_on_that_one():
    case = Golden("smolvla/two_views")
    command = [*EMULATOR, ARM, "serve", case.bundle, "--bind", "tcp://127.0.0.1:0", "--threads", "2", "--kernels", "neon"]
    server = subprocess.Popen(list(map(str, command)), stdout=subprocess.PIPE, text=True, env={**os.environ, "QEMU_CPU": "cortex-a76"})
    try:
        address = re.search(r"tcp://127\.0\.0\.1:\d+", server.stdout.readline())[0]
        with vla_cpp.Client(address, timeout=300) as client:
            images = {view: None if file is None else file.read_bytes() for view, file in case.images.items()}
            answers = [client.act(images=images, state=case.state, text=case.text, seed=s).actions for s in (1, 1, 2)]
    finally:
        server.terminate()
        assert server.wait(300) == 0
    assert np.array_equal(answers[0], answers[1]) and not np.array_equal(answers[0], answers[2])


def test_noise_pixels_and_codes_of_weights_are_those_of_another_machine():
    tool = Path(ARM).with_name("bytes_tool")
    assert run(*EMULATOR, tool) == run(Path(HERE).with_name("bytes_tool"))

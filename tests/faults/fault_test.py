# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""A driver that fails in the middle, as ggml-cuda tells it: by an abort in a library of its own. It must be the error `device`, at
every door, and freeing what the driver no longer knows must not end the process."""

import re
import subprocess
import sys

import pytest
from conftest import DEVICE, ROOT, address
from program import EXIT

LOST = r"cuda:0[^\n]*: expected a device that answers, found CUDA error: unspecified launch failure; [^\n]*: in {call}; start the process again; "


def position(calls, which):
    """Of a call, from 1: the first or the last of its kind."""
    order, call = which.split()
    return 1 + (calls.index(call) if order == "first" else len(calls) - 1 - calls[::-1].index(call))


@pytest.mark.parametrize(
    "which", ["first allocate", "last allocate", "first set", "last set", "first memset", "first compute", "last compute", "last get"]
)
def test_a_call_that_fails_is_a_device_error_of_one_line(fake, golden, which):
    arguments = golden.arguments(options=["--json", *DEVICE])
    n = position(fake.calls(*arguments), which)
    answer = fake.program(fails_at=n)(*arguments)
    assert answer.code == EXIT["device"] and answer.out == "", (answer.code, answer.err)
    assert re.match(r"error: device: " + LOST.format(call=which.split()[1]), answer.err), answer.err
    assert answer.err.count("\n") == 1



def test_after_a_loss_every_act_is_refused_and_closing_the_policy_ends_nothing(fake, golden):
    """Through the C interface, on which Python stands: the second act fails in a step, the third at once, and so does another policy."""
    program = f"""
import sys
sys.path[:0] = [{str(ROOT / "python")!r}]
import vla_cpp
images = {{ {", ".join(f"{view!r}: open({str(file)!r}, 'rb').read()" for view, file in golden.images.items())} }}
def tell(call):
    try:
        call()
        print("done")
    except vla_cpp.VlaError as error:
        print(error.code, error)
policy = vla_cpp.Policy({str(golden.bundle)!r}, device="cuda")
for _ in range(3):
    tell(lambda: policy.act(images=images, state={golden.state!r}, text={golden.text!r}, seed=1))
tell(policy.close)
tell(lambda: vla_cpp.Policy({str(golden.bundle)!r}, device="cuda"))
"""

    def run(**settings):
        environment = {**fake.program(**settings).environment, "VLA_LIBRARY": str(fake.library)}
        result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, env=environment)
        assert result.returncode == 0, (result.returncode, result.stderr)
        return result.stdout.splitlines()

    assert run(counts=fake.counts) == ["done"] * 5
    calls = fake.counts.read_text(encoding="utf-8").split()
    downloads = [i for i, call in enumerate(calls) if call == "get"]
    assert len(downloads) == 3
    lines = run(fails_at=position(calls[: downloads[1]], "last compute"))
    assert lines[0] == "done" and lines[3] == "done"
    assert re.match("device " + LOST.format(call="compute"), lines[1]), lines
    assert lines[2] == lines[1]
    assert re.match("device " + LOST.format(call="allocate"), lines[4]), lines


@pytest.fixture
def third_act(fake, golden):
    """Of the driver's calls one in the third act of a server, counting the one that warms it up."""
    calls = fake.calls(*golden.arguments(options=DEVICE))
    first = max(i for i, call in enumerate(calls) if call == "memset")  # what follows is the act
    n_act = calls.index("get") - first
    return first + 2 * n_act + n_act // 2


def acts(server, golden):
    """Codes of answers, until the server is gone."""
    import vla_cpp

    codes = []
    with vla_cpp.Client(address(server), timeout=20) as client:
        images = {view: file.read_bytes() for view, file in golden.images.items()}
        for _ in range(4):
            try:
                client.act(images=images, state=golden.state, text=golden.text, seed=1)
                codes.append("chunk")
            except vla_cpp.VlaError as error:
                codes.append(error.code)
            if codes[-1] != "chunk":
                return codes
    return codes


def test_a_server_that_lost_its_device_answers_device_and_ends_with_exit_code_8(serve, golden, third_act):
    server = serve(fails_at=third_act)
    codes = acts(server, golden)
    assert "chunk" in codes and codes[-1] == "device", codes
    out, err = server.communicate(timeout=20)
    assert server.returncode == EXIT["device"] and out == ""
    assert re.search(r"^error: device: " + LOST.format(call=r"\w+"), err, re.M), err


def test_a_server_that_is_to_restart_does_so_and_serves_again(serve, golden, third_act):
    """The same process with the same arguments: its fake driver counts from the start again."""
    server = serve("--restart-on-device-loss", fails_at=third_act)
    first, second = acts(server, golden), acts(server, golden)
    assert first == second and first[-1] == "device" and "chunk" in first
    assert server.poll() is None


def test_a_server_that_never_was_ready_does_not_restart(serve, golden):
    server = serve("--restart-on-device-loss", fails_at=1)
    out, err = server.communicate(timeout=20)
    assert server.returncode == EXIT["device"] and out == "", err


@pytest.mark.parametrize("option", ["--record", "--trace"])
def test_files_that_a_second_start_would_find_in_its_way_are_refused(serve, tmp_path, option):
    server = serve("--restart-on-device-loss", option, tmp_path / "file")
    _, err = server.communicate(timeout=20)
    assert server.returncode == EXIT["usage"] and f"{option} excludes --restart-on-device-loss" in err, err

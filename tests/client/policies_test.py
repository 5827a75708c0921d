# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Several policies at one server: acts name theirs, and `vla ctl` loads, swaps and unloads them while robots act."""

import shlex
import signal
import socket
import stat
import subprocess
import threading
import time
import urllib.request

import numpy as np
import pytest
from convert_and_run_test import convert
from faults_test import resident_mib
from golden_cases import Golden
from server_process import SECONDS, VLA, frames

import vla_cpp

PICK, PLACE = Golden("two_views"), Golden("one_view")


class Fleet:
    """`vla serve` of two policies with a socket for orders."""

    def __init__(self, folder, *options):
        self.socket = folder / "control.sock"
        command = [VLA, "serve", f"pick={PICK.bundle}", f"place={PLACE.bundle}", "--bind", "tcp://127.0.0.1:0", "--threads", "1"]
        command += ["--control", self.socket, "--metrics", "127.0.0.1:0", *options]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        lines = [self.process.stdout.readline() for _ in range(3)]
        assert [line.split()[0] for line in lines] == ["policy", "policy", "ready"]
        self.policies = [dict(field.split("=", 1) for field in shlex.split(line)[1:]) for line in lines[:2]]
        self.told = dict(field.split("=", 1) for field in shlex.split(lines[2])[1:])
        self.address = self.told["address"]

    def order(self, *words):
        return subprocess.run([VLA, "ctl", self.socket, *words], capture_output=True, text=True, timeout=60)

    def loaded(self):
        return {line.split()[0] for line in self.order("list").stdout.splitlines()}

    def metrics(self):
        with urllib.request.urlopen(f"http://{self.told['metrics']}/metrics", timeout=SECONDS) as page:
            return page.read().decode()

    def end(self):
        self.process.send_signal(signal.SIGTERM)
        self.process.wait(SECONDS)
        self.process.stdout.close()
        return self.process.returncode


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    fleet = Fleet(tmp_path_factory.mktemp("fleet"))
    yield fleet
    assert fleet.end() == 0


@pytest.fixture(scope="module")
def version(tmp_path_factory):
    """The weights of `pick` in a file of other bytes, whose actions are the same with float32 and nearly so otherwise."""
    return convert(PICK, tmp_path_factory.mktemp("version") / "pick-2.gguf", "f32")


def observation(case, **more):
    return {"images": frames(case), "state": case.state, "text": case.text, "seed": 3, **more}


def alone(case):
    with vla_cpp.Policy(case.bundle, threads=1) as policy:
        return policy.act(**observation(case)).actions


def test_each_act_is_answered_by_the_policy_that_it_names(fleet):
    assert [(policy["name"], policy["arch"]) for policy in fleet.policies] == [("pick", "smolvla"), ("place", "smolvla")]
    assert all(float(policy["memory_mb"]) > 0 for policy in fleet.policies)
    for name, case in (("pick", PICK), ("place", PLACE)):
        with vla_cpp.Client(fleet.address, policy=name, timeout=SECONDS) as client:
            assert client.act(**observation(case)).actions.tobytes() == alone(case).tobytes()
            assert client.spec.bundle.checksum == client.act(**observation(case)).bundle.checksum


@pytest.mark.parametrize("name, found", [(None, "none"), ("pack", "pack")])
def test_an_act_that_names_none_of_them_is_refused_with_their_names(fleet, name, found):
    with vla_cpp.Client(fleet.address, policy=name, timeout=SECONDS) as client:
        with pytest.raises(vla_cpp.BadObservation, match=f"expected one of pick, place, found {found}"):
            client.act(**observation(PICK))


def test_only_this_user_may_give_orders(fleet):
    assert stat.S_IMODE(fleet.socket.stat().st_mode) == 0o600


def test_the_socket_takes_no_path_that_is_in_use_but_that_of_a_server_that_was_killed(fleet, tmp_path):
    plain = tmp_path / "plain"
    plain.write_text("mine")
    for path, found in ((plain, "a file that is no socket"), (fleet.socket, "one that a running program serves")):
        answer = subprocess.run([VLA, "serve", PICK.bundle, "--bind", "tcp://127.0.0.1:0", "--control", path], capture_output=True, text=True, timeout=60)
        assert (answer.returncode, found in answer.stderr) == (9, True), answer.stderr
    assert plain.read_text() == "mine" and fleet.loaded() == {"pick", "place"}
    killed = Fleet(tmp_path)
    killed.process.kill()
    killed.process.communicate(timeout=SECONDS)
    assert killed.socket.exists()
    again = Fleet(tmp_path)
    assert again.loaded() == {"pick", "place"}
    assert again.end() == 0


def test_a_version_takes_the_place_of_another_while_robots_act_and_none_loses_an_answer(fleet, version):
    expected, checksums, problems, done = alone(PICK), [], [], threading.Event()

    def act():
        try:
            with vla_cpp.Client(fleet.address, policy="pick", timeout=SECONDS) as client:
                while not done.is_set():
                    chunk = client.act(**observation(PICK))
                    assert np.abs(chunk.actions - expected).max() < 0.05 * np.abs(expected).max()
                    checksums.append(chunk.bundle.checksum)
        except BaseException as problem:
            problems.append(problem)

    robots = [threading.Thread(target=act) for _ in range(3)]
    [robot.start() for robot in robots]
    try:
        before = None
        for bundle in (version, PICK.bundle) * 4:
            answer = fleet.order("load", f"pick={bundle}")
            assert answer.returncode == 0, answer.stderr
            assert answer.stdout.startswith("pick answers: loaded in ")
            seen, end = len(checksums), time.monotonic() + SECONDS
            while len(checksums) < seen + 6 and not problems:
                assert time.monotonic() < end
                time.sleep(0.01)
            assert len(set(checksums[seen + 3 :])) <= 1  # the new one: acts in line at the swap went to the one before
            before = before or resident_mib(fleet)
        assert resident_mib(fleet) < before + 16
    finally:
        done.set()
        [robot.join() for robot in robots]
    assert not problems
    assert len(set(checksums)) == 2


def test_a_client_that_names_no_version_of_a_policy_hears_that_it_is_another(tmp_path, version):
    fleet = Fleet(tmp_path, "--default-policy", "pick")
    try:
        with vla_cpp.Client(fleet.address, timeout=SECONDS) as client:
            client.act(**observation(PICK))
            assert fleet.order("load", f"pick={version}").returncode == 0
            with pytest.raises(vla_cpp.Incompatible, match="make a new Client"):
                client.act(**observation(PICK))
        assert "the one that answers" in fleet.order("unload", "pick").stderr
    finally:
        assert fleet.end() == 0


def test_a_policy_comes_and_goes(fleet):
    assert fleet.order("load", f"third={PLACE.bundle}").returncode == 0
    assert fleet.loaded() == {"pick", "place", "third"}
    assert 'policy="third"' in fleet.metrics()
    with vla_cpp.Client(fleet.address, policy="third", timeout=SECONDS) as client:
        assert client.act(**observation(PLACE)).actions.tobytes() == alone(PLACE).tobytes()
        assert fleet.order("unload", "third").returncode == 0
        with pytest.raises(vla_cpp.BadObservation, match="expected one of pick, place, found third"):
            client.act(**observation(PLACE))
    assert fleet.loaded() == {"pick", "place"}
    assert 'policy="third"' not in fleet.metrics()


def test_what_cannot_be_loaded_is_refused_and_the_others_go_on(fleet, tmp_path):
    cut = tmp_path / "cut.gguf"
    cut.write_bytes(PICK.bundle.read_bytes()[:-1000])
    for words, code, text in (
        (("load", f"pick={PLACE.bundle}"), 12, "load it under another name"),
        (("load", f"pick={cut}"), 3, "cut.gguf"),
        (("load", f"pick={tmp_path}/none.gguf"), 9, "No such file"),
        (("load", tmp_path / "a b.gguf"), 2, "a name of 1 to 64 letters"),
        (("unload", "fourth"), 4, "expected one of pick, place, found fourth"),
        (("load",), 2, "expected a policy"),
        (("list", "more"), 2, "expected nothing more, found more"),
    ):
        answer = fleet.order(*words)
        assert (answer.returncode, text in answer.stderr) == (code, True), answer.stderr
    assert fleet.loaded() == {"pick", "place"}


@pytest.mark.parametrize("line", [b"", b"\n", b"{}\n", b"[1]\n", b'{"do": 3}\n', b'{"do": "load"}\n', b"\xff\xfe\n", b"x" * 100_000 + b"\n"])
def test_other_lines_on_the_socket_are_refused(fleet, line):
    with socket.socket(socket.AF_UNIX) as peer:
        peer.settimeout(SECONDS)
        peer.connect(str(fleet.socket))
        try:
            peer.sendall(line)
            peer.shutdown(socket.SHUT_WR)
        except BrokenPipeError:
            pass
        assert b'"error"' in peer.recv(4096)
    assert fleet.loaded() == {"pick", "place"}


def test_a_server_that_drains_answers_and_ends(tmp_path):
    fleet = Fleet(tmp_path)
    with vla_cpp.Client(fleet.address, policy="pick", timeout=SECONDS) as client:
        client.act(**observation(PICK))
        assert fleet.order("drain").returncode == 0
        assert fleet.process.wait(SECONDS) == 0
    assert not fleet.socket.exists()
    assert fleet.order("list").returncode == 9
    fleet.process.stdout.close()


@pytest.mark.parametrize(
    "options, text",
    [
        (["--openpi", "127.0.0.1:0"], "--default-policy: expected one of pick, place, found none"),
        (["--default-policy", "pack"], "--default-policy: expected one of pick, place, found pack"),
        (["--record", "r"], "--record: expected one bundle, without --control, found 2 bundles"),
        (["--page", "127.0.0.1:0"], "--page: expected one bundle, without --control, found 2 bundles"),
    ],
)
def test_options_that_several_policies_leave_open_are_refused(tmp_path, options, text):
    answer = subprocess.run([VLA, "serve", f"pick={PICK.bundle}", f"place={PLACE.bundle}", "--bind", "tcp://127.0.0.1:0", *options],
                            capture_output=True, text=True, cwd=tmp_path, timeout=60)  # fmt: skip
    assert (answer.returncode, text in answer.stderr) == (2, True), answer.stderr


def test_two_bundles_of_one_name_are_refused():
    answer = subprocess.run([VLA, "serve", PICK.bundle, PLACE.bundle], capture_output=True, text=True, timeout=60)
    assert answer.returncode == 2 and "two of bundle" in answer.stderr

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What the programs write: whole or not at all, and readable by those only whom it concerns."""

import json
import os
import resource
import signal
import stat
import subprocess
import sys
import time

import numpy as np
import pytest
import wire
from conftest import ROOT
from program import IS_SANITIZED
from serve_test import Server

sys.path.append(str(ROOT / "tests/client"))
import hostile  # noqa: E402

LOCAL = ("--bind", "tcp://127.0.0.1:0", "--threads", "1")
MODE = 0o777


def mode(path):
    return stat.S_IMODE(path.stat().st_mode) & MODE


def limited(vla, size, *args):
    """Runs with a limit on the size of files: what a full disk does, where nobody may mount one."""
    return subprocess.run(
        [vla.path, *map(str, args)], env=vla.environment, capture_output=True, text=True, timeout=60,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size)),
    )  # fmt: skip


@pytest.mark.parametrize("option", ["--out", "--taps-out"])
def test_an_output_that_does_not_fit_leaves_the_old_file_and_nothing_else(vla, golden, tmp_path, option):
    path = tmp_path / "out"
    path.write_bytes(b"before")
    options = (option, path) + (("--tap", "*") if option == "--taps-out" else ())
    full = limited(vla, 100, *golden.arguments(options=options))
    assert full.returncode == 9 and full.stderr.startswith(f"error: io: {path}: ") and full.stdout == ""
    assert path.read_bytes() == b"before" and os.listdir(tmp_path) == ["out"]


def test_an_output_takes_the_place_of_a_file_behind_a_link_and_is_written_into_a_pipe(vla, golden, tmp_path):
    target, link, pipe = tmp_path / "target", tmp_path / "link", tmp_path / "pipe"
    target.write_bytes(b"before")
    link.symlink_to(target)
    assert vla(*golden.arguments(options=("--out", link))).code == 0
    assert link.is_symlink() and np.load(target).dtype == np.float32
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    assert vla(*golden.arguments(options=("--out", pipe))).code == 0
    assert os.read(reader, 1 << 20) == target.read_bytes()
    os.close(reader)


def test_an_output_is_written_to_a_device_and_an_open_file_which_stay_what_they_are(vla, golden, tmp_path):
    link = tmp_path / "policy.npy"
    link.symlink_to("v3.npy")
    for out in ("/dev/null", link):
        assert vla(*golden.arguments(options=("--out", out))).code == 0
    assert stat.S_ISCHR(os.stat("/dev/null").st_mode) and link.is_symlink() and np.load(tmp_path / "v3.npy").dtype == np.float32
    with open(tmp_path / "log", "ab") as log:
        log.write(b"so far")
        log.flush()
        command = [vla.path, *map(str, golden.arguments(options=("--out", "/dev/stdout", "--json")))]
        assert subprocess.run(command, env=vla.environment, stdout=log, timeout=60).returncode == 0
    data = (tmp_path / "log").read_bytes()
    assert data.startswith(b"so far\x93NUMPY") and data.endswith(b"}\n")
    vla(*golden.arguments(options=("--out", tmp_path))).refused("io", str(tmp_path), "directory")


def test_a_trace_into_a_device_leaves_its_mode(vla, golden):
    before = os.stat("/dev/null").st_mode
    server = Server(vla, golden.bundle, *LOCAL, "--trace", "/dev/null")
    assert server.stop(signal.SIGTERM)[0] == 0 and os.stat("/dev/null").st_mode == before


def test_a_key_that_does_not_fit_leaves_no_file(vla, tmp_path):
    full = limited(vla, 10, "keygen", tmp_path / "key")
    assert full.returncode == 9 and os.listdir(tmp_path) == []


def test_recordings_and_traces_are_for_their_owner_only(vla, golden, tmp_path):
    trace = tmp_path / "trace.json"
    trace.write_text("before")
    trace.chmod(0o644)
    server = Server(vla, golden.bundle, *LOCAL, "--record", tmp_path / "recording", "--trace", trace)
    try:
        peer = wire.Peer(server.ready["address"])
        peer.ask(wire.health(1))
        peer.close()
        assert mode(tmp_path / "recording") == 0o700
        assert mode(tmp_path / "recording/requests.vlarec") == 0o600
        assert mode(trace) == 0o600
        assert server.stop(signal.SIGTERM)[0] == 0
    finally:
        server.process.kill()


@pytest.mark.parametrize("n_act", [2, 5])  # the second is larger than the disk: without a third the end tells it
def test_a_server_on_a_full_disk_stops_recording_and_answers_on(vla, golden, tmp_path, n_act):
    files = ("--record", tmp_path / "recording", "--trace", tmp_path / "trace.json")
    server = Server(vla, golden.bundle, *LOCAL, *files, "--log", "json", limit=20_000)
    peer = wire.Peer(server.ready["address"])
    try:
        for i in range(n_act):
            assert wire.kind(peer.ask(wire.act(i, golden, seed=i))) == "chunk"
    finally:
        peer.close()
    code, _, log = server.stop(signal.SIGTERM)
    stopped = [event for event in map(json.loads, log.splitlines()) if event["event"] == "record_stopped"]
    assert code == 0 and len(stopped) == 1 and stopped[0]["requests"] < n_act
    if n_act == 2:  # told at the end, when the disk has what it will have
        assert stopped[0]["requests"] == 1
    json.loads((tmp_path / "trace.json").read_text())
    assert all(file.stat().st_size <= 20_000 for file in tmp_path.rglob("*") if file.is_file())


@pytest.mark.skipif(IS_SANITIZED, reason="the address sanitizer takes terabytes of address space")
def test_threads_that_the_system_does_not_give_are_an_error(vla, golden):
    """Their stacks are larger than the address space: 64 MiB each, whatever this session's own limit says."""
    arguments = ["256" if a == "2" else str(a) for a in golden.arguments()]

    def limit():
        resource.setrlimit(resource.RLIMIT_STACK, (64 << 20, 64 << 20))
        resource.setrlimit(resource.RLIMIT_AS, (4 << 30, 4 << 30))

    answer = subprocess.run(
        [vla.path, *arguments], env=vla.environment, capture_output=True, text=True, timeout=60, preexec_fn=limit
    )
    assert answer.returncode == 8 and answer.stderr.startswith("error: device: threads: expected 256, found ")


def test_two_signals_end_a_server_at_once_though_peers_are_in_the_midst_of_their_requests(vla, golden):
    server = Server(vla, golden.bundle, *LOCAL)
    peer = wire.Peer(server.ready["address"])
    half = [hostile.connect(server.ready["address"], data) for data in hostile.HALF_SENT.values()]
    try:
        for i in range(20):
            peer.socket.send(wire.act(i, golden, seed=i))
        start = time.monotonic()
        server.process.send_signal(signal.SIGINT)
        server.process.send_signal(signal.SIGTERM)
        server.process.wait(20)
        assert time.monotonic() - start < 4  # waiting for what the peers have begun takes longer
    finally:
        peer.close()
        [raw.close() for raw in half]
        server.process.kill()
        server.process.communicate()


def test_a_second_signal_while_a_server_frees_what_it_has_ends_it(vla, golden):
    """At every moment of its end. A program with sanitizers looks for leaks then, which takes longest."""
    codes = []
    while 0 not in codes:
        server = Server(vla, golden.bundle, *LOCAL)
        try:
            server.process.send_signal(signal.SIGINT)
            time.sleep(0.002 * len(codes))
            server.process.send_signal(signal.SIGTERM)
            out, error = server.process.communicate(timeout=20)
            assert (out, error) == ("", "")
            codes.append(server.process.returncode)
        finally:
            server.process.kill()
    assert set(codes) <= {0, -signal.SIGINT, -signal.SIGTERM}


def test_a_recording_that_is_a_pipe_is_refused_at_once(vla, tmp_path):
    os.mkfifo(tmp_path / "requests.vlarec")
    answer = vla("replay", tmp_path)
    answer.refused("io", "requests.vlarec")
    assert answer.seconds < 20


def test_a_second_signal_ends_a_server_at_once_though_it_is_another_one(vla, golden):
    server = Server(vla, golden.bundle, *LOCAL)
    try:
        server.process.send_signal(signal.SIGSTOP)  # so that both have come before the server can be done
        server.process.send_signal(signal.SIGINT)
        server.process.send_signal(signal.SIGTERM)
        server.process.send_signal(signal.SIGCONT)
        assert server.process.wait(20) in (-signal.SIGINT, -signal.SIGTERM)
    finally:
        server.process.kill()
        server.process.communicate()


@pytest.mark.parametrize("what", ["note", "error", "usage"])
def test_a_standard_error_that_cannot_be_written_changes_no_exit_code(vla, golden, what):
    arguments = {"note": list(map(str, golden.arguments())), "error": ["inspect", "/nowhere"], "usage": ["inspect"]}[what]
    if what == "note":
        at = arguments.index("--noise")
        del arguments[at : at + 2]  # a seed is drawn, and told
    call = dict(args=[vla.path, *arguments], env=vla.environment, stdout=subprocess.DEVNULL, timeout=60)
    expected = {"note": 0, "error": 9, "usage": 2}[what]
    with open("/dev/full", "w") as full:
        assert subprocess.run(stderr=full, **call).returncode == expected
    assert subprocess.run(preexec_fn=lambda: os.close(2), **call).returncode == expected


def test_no_file_takes_the_place_of_a_closed_stream(vla, golden, tmp_path):
    """A server without standard output and standard error, that records: what it prints must not end up in its files."""
    address = f"ipc://{tmp_path}/socket"
    options = ["--bind", address, "--threads", "1", "--record", tmp_path / "recording", "--trace", tmp_path / "trace.json"]
    process = subprocess.Popen(
        [vla.path, "serve", *map(str, [golden.bundle, *options]), "--log", "json", "--log-level", "debug"],
        env=vla.environment, preexec_fn=lambda: [os.close(stream) for stream in (0, 1, 2)],
    )  # fmt: skip
    try:
        peer = wire.Peer(address)
        assert wire.kind(peer.ask(wire.act(1, golden, seed=1))) == "chunk"
        peer.close()
        process.send_signal(signal.SIGTERM)
        assert process.wait(30) == 9  # the ready line could not be written
    finally:
        process.kill()
    json.loads((tmp_path / "trace.json").read_text())
    assert vla("replay", tmp_path / "recording", "--bundle", golden.bundle, "--threads", "1").code == 0


@pytest.mark.skipif(IS_SANITIZED, reason="the sanitizer looks at memory through descriptors of its own")
def test_sockets_that_the_system_does_not_give_are_an_error(vla, golden):
    """For each number of file descriptors, up to the one that suffices."""
    for n in range(8, 3, -1):
        answer = subprocess.run(
            [vla.path, "serve", str(golden.bundle), *LOCAL, "--metrics", "127.0.0.1:0"],
            env=vla.environment, capture_output=True, text=True, timeout=60,
            preexec_fn=lambda n=n: resource.setrlimit(resource.RLIMIT_NOFILE, (n, n)),
        )  # fmt: skip
        assert answer.returncode == 9 and answer.stderr.startswith("error: io: "), (n, answer)

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""`vla serve` and `vla keygen` as a supervisor and a user see them: ready line, signals, exit codes, refusals. What goes over
the wire is tested in tests/serve/."""

import re
import resource
import selectors
import shlex
import signal
import socket
import stat
import subprocess

import pytest


class Server:
    """A running `vla serve` on a free port; `ready` has the fields of its ready line. limit: of the size of files, as a full disk."""

    def __init__(self, vla, *args, limit=None):
        self.process = subprocess.Popen(
            [vla.path, "serve", *map(str, args)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=vla.environment,
            preexec_fn=limit and (lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))),
        )
        with selectors.DefaultSelector() as selector:
            selector.register(self.process.stdout, selectors.EVENT_READ)
            assert selector.select(60), "no ready line within a minute"
        self.line = self.process.stdout.readline()
        word, *fields = shlex.split(self.line)
        assert word == "ready", self.line
        self.ready = dict(field.split("=", 1) for field in fields)

    def stop(self, number):
        self.process.send_signal(number)
        out, err = self.process.communicate(timeout=30)
        return self.process.returncode, out, err


@pytest.fixture
def serve(vla):
    servers = []

    def start(*args):
        servers.append(Server(vla, *args))
        return servers[-1]

    yield start
    for server in servers:
        server.process.kill()
        server.process.communicate()


def test_the_ready_line_says_where_and_what_and_the_address_is_open(serve, golden):
    ready = serve(golden.bundle, "--bind", "tcp://127.0.0.1:0").ready
    assert set(ready) == {
        "address", "bundle", "arch", "device", "precision", "kernels", "memory_mb", "connections", "features", "load_ms",
        "warm_up_ms",
    }  # fmt: skip
    host, port = re.fullmatch(r"tcp://(127\.0\.0\.1):(\d+)", ready["address"]).groups()
    socket.create_connection((host, int(port)), timeout=5).close()
    assert ready["arch"] == "smolvla" and ready["bundle"] == "bundle.gguf"
    assert "observation.state" in ready["features"].split(",")
    assert all(float(ready[number]) > 0 for number in ("load_ms", "warm_up_ms", "memory_mb"))


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_it_with_success_and_nothing_more_is_printed(serve, golden, number):
    assert serve(golden.bundle, "--bind", "tcp://127.0.0.1:0").stop(number) == (0, "", "")


def test_several_addresses_are_bound_and_told(serve, golden, tmp_path):
    path = tmp_path / "socket"
    ready = serve(golden.bundle, "--bind", "tcp://127.0.0.1:0", "--bind", f"ipc://{path}").ready
    tcp, ipc = ready["address"].split(",")
    assert tcp.startswith("tcp://127.0.0.1:") and ipc == f"ipc://{path}" and path.is_socket()


def test_a_bundle_whose_name_has_quotes_leaves_the_line_whole(serve, golden, tmp_path):
    bundle = tmp_path / "bob's \"own\" policy.gguf"
    bundle.symlink_to(golden.bundle)
    assert serve(bundle, "--bind", "tcp://127.0.0.1:0").ready["bundle"] == bundle.name


def test_an_address_in_use_is_an_io_error_that_names_the_option(vla, serve, golden):
    address = serve(golden.bundle, "--bind", "tcp://127.0.0.1:0").ready["address"]
    vla("serve", golden.bundle, "--bind", address).refused("io", address, "--bind")


def test_an_address_that_others_reach_needs_keys_or_insecure(vla, serve, golden):
    for address in ("tcp://*:0", "tcp://0.0.0.0:0"):
        vla("serve", golden.bundle, "--bind", address).refused("usage", "--bind", "vla keygen", "--insecure")
    assert serve(golden.bundle, "--bind", "tcp://0.0.0.0:0", "--insecure").ready


def test_keys_from_keygen_serve_and_half_a_pair_does_not(vla, serve, golden, tmp_path):
    answer = vla("keygen", tmp_path / "server")
    secret, public = answer.out.splitlines()
    assert answer.code == 0 and stat.S_IMODE((tmp_path / "server.secret").stat().st_mode) == 0o600
    vla("keygen", tmp_path / "server").refused("io", "server.public")
    vla("serve", golden.bundle, "--curve-secret", secret).refused("usage", "--curve-clients")
    vla("serve", golden.bundle, "--curve-secret", public, "--curve-clients", public).refused("usage", "chmod 600")
    assert serve(golden.bundle, "--bind", "tcp://*:0", "--curve-secret", secret, "--curve-clients", public).ready


@pytest.mark.parametrize(
    "args", [("--bind", "localhost:5555"), ("--queue", "0"), ("--max-message", "0"), ("--kernels", "abacus")]
)
def test_what_cannot_be_right_is_a_usage_error(vla, golden, args):
    vla("serve", golden.bundle, *args).refused("usage", args[0].strip("-"))


def test_a_damaged_bundle_is_refused_as_by_every_other_command(vla, tmp_path):
    damaged = tmp_path / "damaged.gguf"
    damaged.write_bytes(b"GGUF but not really")
    vla("serve", damaged, "--bind", "tcp://127.0.0.1:0").refused("bad_bundle", "damaged.gguf")

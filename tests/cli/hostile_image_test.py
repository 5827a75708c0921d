# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""PNG files that unpack to gigabytes, through the command line and through the server: neither memory nor time."""

import re
import time
from pathlib import Path

import pytest
import wire
from golden_cases import Golden
from image_files import hostile_pngs
from serve_test import Server

FAMILY = hostile_pngs(Golden("two_views").images["camera1"].read_bytes())
MOST_SECONDS, MOST_BYTES = 5, 64 << 20


@pytest.fixture(scope="module")
def plain(vla):
    """What the call takes with a sound image."""
    return vla(*Golden("two_views").arguments())


@pytest.fixture(scope="module")
def server(vla):
    server = Server(vla, Golden("two_views").bundle, "--bind", "tcp://127.0.0.1:0", "--threads", "1")
    yield server
    server.process.kill()
    server.process.communicate()


@pytest.fixture
def hostile(golden, tmp_path, what):
    """The golden case with such a file for one view."""
    path = tmp_path / "frame.png"
    path.write_bytes(FAMILY[what][0])
    golden.images = golden.with_image("camera1", path)
    return golden


def most_memory(server):
    return int(re.search(r"VmHWM:\s+(\d+)", Path(f"/proc/{server.process.pid}/status").read_text())[1]) << 10


@pytest.mark.parametrize("what", FAMILY)
def test_on_the_command_line(vla, plain, hostile, what):
    answer = vla(*hostile.arguments())
    if FAMILY[what][1]:
        assert answer.code == 0, answer.err
    else:
        answer.refused("bad_observation", "observation.images.camera1")
    assert answer.seconds < plain.seconds + MOST_SECONDS and answer.peak < plain.peak + MOST_BYTES


@pytest.mark.parametrize("what", FAMILY)
def test_at_a_server(server, golden, hostile, what):
    peer = wire.Peer(server.ready["address"])
    try:
        assert wire.kind(peer.ask(wire.act(1, Golden("two_views"), seed=1))) == "chunk"
        before, start = most_memory(server), time.monotonic()
        answer = peer.ask(wire.act(2, hostile, seed=1))
        assert time.monotonic() - start < MOST_SECONDS and most_memory(server) < before + MOST_BYTES
        assert wire.kind(answer) == ("chunk" if FAMILY[what][1] else "error")
    finally:
        peer.close()

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""A peer that takes what it can get: connections, memory, frames, time. What it can hold is what docs/security.md says, and a client
that behaves is served meanwhile."""

import contextlib
import resource
import socket
import threading
import time
import urllib.request
from urllib.parse import urlsplit

import hostile
import pytest
from faults_test import n_files, request, resident_mib
from server_process import SECONDS, Robot, Server

import vla_cpp

pytestmark = pytest.mark.alone

HEALTH = request("health")


@pytest.fixture
def server(case):
    server = Server(case)
    yield server
    assert server.stop() == 0


def half_sent(address, megabytes=20):
    """A connection that has sent so much of a request of 30 MB."""
    raw = hostile.connect(address, hostile.HANDSHAKE + hostile.long_frame(30_000_000))
    with contextlib.suppress(OSError):  # the server may have closed it by then
        for _ in range(megabytes):
            raw.sendall(bytes(1_000_000))
    return raw


def dripping(address, stopped):
    """Sends a health request byte by byte, again and again."""
    raw = hostile.connect(address, hostile.HANDSHAKE)
    frame = bytes([0, len(HEALTH)]) + HEALTH
    with raw, contextlib.suppress(OSError):
        while not stopped.is_set():
            for i in range(len(frame)):
                raw.sendall(frame[i : i + 1])
                time.sleep(0.001)


def test_forty_half_sent_messages_hold_no_more_than_four_of_the_largest(server, robot):
    robot.acts(5)
    before = resident_mib(server)
    peers = [half_sent(server.address) for _ in range(40)]
    assert resident_mib(server) < before + 4 * 32 + 40
    robot.acts(5)
    for peer in peers:
        peer.close()


def test_a_message_of_millions_of_frames_takes_no_memory_and_holds_nobody_up(server, robot):
    robot.acts(5)
    before, longest = resident_mib(server), 0
    stopped = threading.Event()

    def flood():
        while not stopped.is_set():
            with hostile.connect(server.address, hostile.HANDSHAKE) as raw, contextlib.suppress(OSError):
                raw.sendall(b"\x01\x00" * 1_000_000)

    threads = [threading.Thread(target=flood) for _ in range(2)]
    [thread.start() for thread in threads]
    with vla_cpp.Client(server.address, timeout=SECONDS) as client:
        for _ in range(50):
            start = time.perf_counter()
            assert client.health().ready
            longest = max(longest, time.perf_counter() - start)
    robot.acts(5)
    stopped.set()
    [thread.join() for thread in threads]
    assert resident_mib(server) < before + 20
    assert longest < 1, f"health took {longest:.3f} s"


def test_three_hundred_connections_keep_nobody_out_and_take_no_more_than_the_limit(server, robot):
    robot.acts(5)
    files = n_files(server)
    peers = [hostile.connect(server.address, hostile.HANDSHAKE) for _ in range(300)]
    robot.acts(5)  # the one that is at work is not the one that makes room
    assert n_files(server) <= files + 256
    with vla_cpp.Client(server.address, timeout=SECONDS) as late:
        assert late.health().ready
    for peer in peers:
        peer.close()


def test_with_few_file_descriptors_fewer_connections_are_taken_and_health_is_told_over_http(case):
    server = Server(case, "--metrics", "127.0.0.1:0", before=lambda: resource.setrlimit(resource.RLIMIT_NOFILE, (40, 40)))
    try:
        assert 1 <= int(server.told["connections"]) <= 24
        robot = Robot(server.address, case)
        peers = [hostile.connect(server.address, hostile.HANDSHAKE) for _ in range(60)]
        robot.acts(5)
        for _ in range(10):
            with urllib.request.urlopen(f"http://{server.told['metrics']}/healthz", timeout=SECONDS) as page:
                assert page.status == 200
        [peer.close() for peer in peers]
    finally:
        assert server.stop() == 0


def test_all_of_it_at_once_leaves_a_client_that_behaves_its_answers(server, robot):
    robot.acts(5)
    before, stopped = resident_mib(server), threading.Event()
    host = urlsplit(server.address)
    peers = [half_sent(server.address) for _ in range(10)]
    peers += [hostile.connect(server.address, hostile.GREETING) for _ in range(100)]
    peers += [socket.create_connection((host.hostname, host.port)) for _ in range(100)]
    threads = [threading.Thread(target=dripping, args=(server.address, stopped)) for _ in range(20)]
    [thread.start() for thread in threads]
    try:
        robot.acts(20)
        assert resident_mib(server) < before + 4 * 32 + 40
    finally:
        stopped.set()
        [thread.join() for thread in threads]
        for peer in peers:
            peer.close()

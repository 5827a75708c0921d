# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What a peer that breaks the rules costs others: nothing. A client that behaves acts while it goes on, and each of its
acts must be answered, with its own bytes, in about the time that it takes when nobody disturbs."""

import os
import re
import resource
import subprocess
import threading
import time
from pathlib import Path

import hostile
import numpy as np
import pytest
import zmq
from server_process import SECONDS, Robot, Server, frames

import vla_cpp
from vla_cpp import wire

pytestmark = pytest.mark.alone

LIMIT_MIB = 1  # of a message: enough for what is sent here, and quick to go over


@pytest.fixture(scope="module")
def server(case):
    server = Server(case, "--max-message", str(LIMIT_MIB))
    yield server
    assert server.stop() == 0


def undisturbed(robot, quiet):
    """Generous: the machine may have other work by now. A server that waits for a peer stands still for seconds."""
    disturbed = robot.acts()
    assert disturbed < 5 * quiet + 0.2, f"{disturbed:.3f} s an act, {quiet:.3f} s when nobody disturbs"


def resident_mib(server):
    status = Path(f"/proc/{server.process.pid}/status").read_text()
    return int(re.search(r"VmRSS:\s+(\d+)", status)[1]) / 1024


def new_pages(server):
    """That the process has touched so far."""
    return int(Path(f"/proc/{server.process.pid}/stat").read_text().rpartition(")")[2].split()[7])


def n_files(server):
    return len(os.listdir(f"/proc/{server.process.pid}/fd"))


def eventually(condition):
    until = time.monotonic() + SECONDS
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.05)


@pytest.fixture
def dealer(server):
    """A socket that sends what it is told to."""
    with zmq.Context() as context, context.socket(zmq.DEALER) as socket:
        socket.linger, socket.rcvtimeo = 0, SECONDS * 1000
        socket.sndhwm, socket.reconnect_ivl = 1, 10  # what is sent while there is no connection does not pile up
        socket.connect(server.address)
        yield socket


def request(kind, version=1, number=1):
    message = wire.Request(protocol_version=version, request_id=number)
    getattr(message, kind).SetInParent()
    return message.SerializeToString()


@pytest.mark.parametrize("what", [hostile.HALF_SENT, hostile.GARBAGE], ids=["half_sent", "garbage"])
def test_peers_that_send_what_is_not_zeromq_or_half_of_it_cost_others_nothing(server, robot, what):
    quiet, files = robot.acts(), n_files(server)
    peers = [hostile.connect(server.address, data) for data in what.values() for _ in range(4)]
    undisturbed(robot, quiet)
    for peer in peers:
        hostile.reset(peer)
    undisturbed(robot, quiet)
    eventually(lambda: n_files(server) <= files)


def test_connections_that_break_off_at_every_byte_of_a_request_cost_others_nothing(server, robot):
    quiet = robot.acts()
    body = request("describe")
    data = hostile.HANDSHAKE + bytes([0, len(body)]) + body
    for end in range(len(data) + 1):
        hostile.reset(hostile.connect(server.address, data[:end]))
    undisturbed(robot, quiet)


def test_half_sent_messages_take_memory_only_for_what_was_sent(server, robot):
    before = resident_mib(server)
    peers = [hostile.connect(server.address, hostile.HALF_SENT["half a frame"]) for _ in range(200)]
    peers += [hostile.connect(server.address, hostile.HANDSHAKE + hostile.long_frame(1 << 20)) for _ in range(200)]
    robot.acts()
    assert resident_mib(server) < before + 40
    for peer in peers:
        peer.close()


@pytest.mark.parametrize("version", [0, 2, 2**32 - 1])
def test_a_request_of_another_version_is_refused_and_the_next_one_of_the_same_peer_is_served(dealer, version):
    for kind in ("hello", "describe", "act", "health"):
        dealer.send(request(kind, version, number=5))
        refused = wire.Response.FromString(dealer.recv())
        assert refused.request_id == 5 and refused.error.code == 12 and refused.error.expected == "version 1"
    dealer.send(request("health", number=6))
    assert wire.Response.FromString(dealer.recv()).health.ready


def test_messages_over_the_limit_cost_others_nothing_and_are_answered(server, robot, dealer):
    quiet, before = robot.acts(), resident_mib(server)
    stopped = threading.Event()

    def send():
        while not stopped.is_set():
            try:
                dealer.send(bytes((LIMIT_MIB << 20) + 1), zmq.NOBLOCK)
            except zmq.Again:
                time.sleep(0.01)

    thread = threading.Thread(target=send)
    thread.start()
    undisturbed(robot, quiet)
    stopped.set()
    thread.join()
    assert resident_mib(server) < before + 40
    dealer.send(request("health"))
    answer = wire.Response.FromString(dealer.recv())
    while answer.HasField("error"):
        assert answer.error.code == 13 and answer.error.where == "request"
        answer = wire.Response.FromString(dealer.recv())
    assert answer.health.ready


def test_large_acts_that_are_refused_leave_no_memory_behind(case):
    message = wire.Request(protocol_version=1, request_id=1)
    message.act.text = "x" * 30_000_000
    large = Server(case)
    try:
        with zmq.Context() as context, context.socket(zmq.DEALER) as peer:
            peer.linger, peer.rcvtimeo = 0, SECONDS * 1000
            peer.connect(large.address)
            peer.send(request("health"))
            peer.recv()
            before = resident_mib(large)
            for _ in range(12):
                peer.send(message.SerializeToString())
                assert wire.Response.FromString(peer.recv()).error.code == 13
            eventually(lambda: resident_mib(large) < 1.1 * before + 4)  # while the peer stays
    finally:
        assert large.stop() == 0


def test_acts_of_large_frames_take_no_new_pages(case):
    large = Server(case)
    try:
        with vla_cpp.Client(large.address, timeout=SECONDS) as client:
            act = {
                "images": {view.name: np.zeros((1300, 1300, 3), np.uint8) for view in client.spec.views},
                "state": {state.name: np.zeros(state.width, np.float32) for state in client.spec.states},
            }
            taken = []
            for _ in range(8):
                before = new_pages(large)
                client.act(**act, text="go", seed=1)
                taken.append(new_pages(large) - before)
    finally:
        assert large.stop() == 0
    assert min(taken[2:]) < 100 < max(taken), taken  # of the first one's thousands


def test_a_peer_that_asks_and_never_reads_costs_others_nothing_and_little_memory(server, robot):
    quiet, before = robot.acts(), resident_mib(server)
    stopped = threading.Event()
    describe = request("describe")
    frame = bytes([0, len(describe)]) + describe

    def flood(raw):
        raw.settimeout(0.1)
        while not stopped.is_set():
            try:
                raw.sendall(frame * 100)
            except OSError:  # the server reads no faster than it likes
                stopped.wait(0.01)

    peers = [hostile.connect(server.address, hostile.HANDSHAKE) for _ in range(4)]
    threads = [threading.Thread(target=flood, args=(peer,)) for peer in peers]
    [t.start() for t in threads]
    time.sleep(1)
    undisturbed(robot, quiet)
    stopped.set()
    [t.join() for t in threads]
    assert resident_mib(server) < before + 40
    [peer.close() for peer in peers]


def test_a_client_that_floods_gets_no_more_turns_than_one_that_waits_for_its_answers(server, case):
    observation = {"images": frames(case), "state": case.state, "text": case.text}
    served = {"greedy": 0, "polite": 0}
    until = time.monotonic() + 2

    def ask(name, n_at_once):
        with vla_cpp.Client(server.address, timeout=SECONDS) as client:
            client.spec  # noqa: B018  (asked for before the race)
            while time.monotonic() < until:
                for pending in [client.submit(**observation) for _ in range(n_at_once)]:
                    try:
                        pending.result()
                        served[name] += 1
                    except vla_cpp.Superseded:
                        pass

    threads = [threading.Thread(target=ask, args=a) for a in (("greedy", 20), ("polite", 1))]
    [t.start() for t in threads]
    [t.join() for t in threads]
    assert served["polite"] > 0 and served["greedy"] <= 3 * served["polite"], served  # of 20 times as many


def test_when_the_file_descriptors_are_used_up_those_who_are_connected_are_served_and_others_later(case):
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    server = Server(case)
    try:
        with Robot(server.address, case) as robot:
            quiet, room = robot.acts(), n_files(server) + 20
            resource.prlimit(server.process.pid, resource.RLIMIT_NOFILE, (room, limits[1]))
            peers = [hostile.connect(server.address, hostile.GREETING) for _ in range(60)]
            undisturbed(robot, quiet)
            [hostile.reset(peer) for peer in peers]
            eventually(lambda: n_files(server) < room)
        with vla_cpp.Client(server.address, timeout=SECONDS) as late:
            assert late.health().ready
    finally:
        try:
            assert server.stop() == 0
        except subprocess.TimeoutExpired:
            server.process.kill()
            raise

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What a peer of LeRobot's protocol may take from others. Its calls are made without gRPC's library."""

import argparse
import threading
import time

import numpy as np
import pytest

pytest.importorskip("msgpack")

from drop_in import serving  # noqa: E402
from lerobot_calls import Peer  # noqa: E402
from lerobot_pickles import TimedObservation, dumps, setup_of  # noqa: E402
from server_process import ROOT, frames  # noqa: E402

pytestmark = pytest.mark.alone

ROBOT, OTHER = "127.0.0.1", "127.0.0.2"


def connects(views, state):
    """A function that connects a robot, and its observation."""
    motors = {f"joint_{i}": float(x) for i, x in enumerate(state)}
    setup = dumps(setup_of(motors, views))

    def connect(address, source):
        peer = Peer(address, source)
        peer.setup(setup)
        return peer

    return connect, dumps(TimedObservation(0.0, 0, {**motors, **views, "task": "go"}, True))


def name_of(view):
    return view.removeprefix("observation.images.")


def silent(address, begin, ended):
    """Begins something, and waits for the end of it."""
    try:
        with Peer(address, OTHER) as peer:
            begin(peer)
            peer.wait()
    except OSError:
        ended.append(begin)


@pytest.mark.parametrize(
    "begin",
    [
        lambda peer: [step for _ in range(4) for step in peer.half(3 << 19)],
        lambda peer: [peer.half_message(3 << 19) for _ in range(4)],
        lambda peer: [peer.begin("SendObservations") for _ in range(16)],
        lambda peer: None,
    ],
    ids=["halves of observations", "halves of messages", "calls", "connections"],
)
def test_a_peer_with_much_that_is_not_whole_does_not_take_the_place_of_a_robot(case, begin):
    connect, observation = connects({name_of(v): f for v, f in frames(case).items() if f is not None}, case.state)
    options = ("--lerobot", "127.0.0.1:0", "--max-message", "2", "--connections", "32")
    with serving(case, *options) as (_, address):
        with connect(address("grpc://"), ROBOT) as robot:
            ended = []
            for _ in range(40):
                threading.Thread(target=silent, args=(address("grpc://"), begin, ended), daemon=True).start()
            until = time.monotonic() + 2
            while time.monotonic() < until:
                robot.act(observation)
            assert ended  # it was too much


def test_a_peer_with_many_connections_gets_a_robots_turns_only():
    """With a policy that computes for longer than its clients take to ask."""
    slow = argparse.Namespace(bundle=ROOT / "models/metaworld-tiny.gguf")
    connect, observation = connects({"corner4": np.zeros((480, 480, 3), np.uint8)}, [0.1] * 4)
    with serving(slow, "--lerobot", "127.0.0.1:0", "--map", "observation.images.corner4=corner4") as (_, address):
        counts, stop = [0] * 24, threading.Event()

        def ask_for_ever(n):
            with connect(address("grpc://"), OTHER) as peer:
                while not stop.is_set():
                    peer.act(observation)
                    counts[n] += 1

        with connect(address("grpc://"), ROBOT) as robot:
            threads = [threading.Thread(target=ask_for_ever, args=(n,)) for n in range(len(counts))]
            [thread.start() for thread in threads]
            while not all(counts):
                time.sleep(0.01)
            others = []
            for _ in range(11):
                robot.observe(observation)
                before = sum(counts)
                robot.actions()
                others.append(sum(counts) - before)
            stop.set()
            [thread.join() for thread in threads]
        # With a turn for each connection all were 24 and more; beside other programs this client sees some answers late.
        assert sorted(others)[2] <= 18, others


def test_observations_that_nobody_asks_for_are_forgotten_before_they_are_too_much(case):
    connect, observation = connects({name_of(v): np.zeros((600, 1000, 3), np.uint8) for v in frames(case)}, case.state)
    options = ("--lerobot", "127.0.0.1:0", "--max-message", str(len(observation) // 2**20 + 1))
    with serving(case, *options) as (_, address):
        peers = [connect(address("grpc://"), OTHER) for _ in range(6)]
        for peer in peers:
            peer.observe(observation)
        start = time.monotonic()
        peers[0].actions()
        assert time.monotonic() - start > 0.9  # it has no observation, which a robot gets two seconds for
        peers[-1].actions()
        [peer.__exit__() for peer in peers]

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""LeRobot's own robot_client, unmodified, with a robot that is not there, at `vla serve --lerobot` of the shipped policy.

VLA_BINARY names a `vla` that was built with libgrpc++. LeRobot needs its extra `async`, or grpcio.
"""

import os
import re
import subprocess
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import vla_cpp

from vla_cpp.eval import lerobot_reference  # noqa: F401  (before lerobot: for Python 3.11, and offline)

pytest.importorskip("grpc")
robot_client = pytest.importorskip("lerobot.async_inference.robot_client")
from lerobot.async_inference.configs import RobotClientConfig  # noqa: E402
from lerobot.robots import RobotConfig  # noqa: E402

ROOT = Path(__file__).resolve().parents[3]
VLA = Path(os.environ.get("VLA_BINARY", ROOT / "build/cpu/bin/vla"))
MOTORS = ["x", "y", "z", "gripper"]


class Config(RobotConfig):
    pass


class Arm:
    """Moves where it is told, and sees noise."""

    observation_features = {**{f"{m}.pos": float for m in MOTORS}, "corner4": (128, 128, 3)}
    action_features = {f"{m}.pos": float for m in MOTORS}

    def __init__(self):
        self.at, self.done, self.draw = np.zeros(4), [], np.random.default_rng(0)

    def connect(self):
        pass

    disconnect = connect

    def get_observation(self):
        frame = self.draw.integers(0, 256, (128, 128, 3), dtype=np.uint8)
        return {**{f"{m}.pos": float(v) for m, v in zip(MOTORS, self.at)}, "corner4": frame}

    def send_action(self, action):
        self.done.append(action)
        self.at = self.at + 0.01 * np.array(list(action.values()))
        return action


@pytest.fixture
def address():
    command = [VLA, "serve", ROOT / "models/metaworld-tiny.gguf", "--bind", "tcp://127.0.0.1:0", "--lerobot", "127.0.0.1:0"]
    server = subprocess.Popen(list(map(str, command)), stdout=subprocess.PIPE, text=True)
    line = server.stdout.readline()
    yield re.search(r"grpc://([\d.:]+)", line)[1], re.search(r"tcp://[\d.:]+", line)[0]
    server.terminate()
    assert server.wait(20) == 0


def client_of(address, monkeypatch, arm):
    monkeypatch.setattr(robot_client, "make_robot_from_config", lambda config: arm)
    config = RobotClientConfig(
        policy_type="smolvla", pretrained_name_or_path="not/looked-at", robot=Config(), actions_per_chunk=16,
        server_address=address[0], task="open the faucet", fps=80,
    )  # fmt: skip
    return robot_client.RobotClient(config)


def test_an_episode(address, monkeypatch):
    arm = Arm()
    client = client_of(address, monkeypatch, arm)
    assert client.start()
    threads = [threading.Thread(target=client.receive_actions), threading.Thread(target=client.control_loop, args=("open the faucet",))]
    [thread.start() for thread in threads]
    until = time.monotonic() + 60
    while len(arm.done) < 100 and time.monotonic() < until:
        time.sleep(0.05)
    client.stop()
    [thread.join(10) for thread in threads]
    assert len(arm.done) >= 100
    assert all(np.isfinite(list(action.values())).all() for action in arm.done)


def test_the_time_over_the_native_protocol(address, monkeypatch, capsys):
    """Of an observation and its chunk, through the calls of LeRobot's client, by turns with ours."""
    arm = Arm()
    client = client_of(address, monkeypatch, arm)
    assert client.start()
    taken, native = [], []
    with vla_cpp.Client(address[1]) as ours:
        for step in range(200):
            seen = {**arm.get_observation(), "task": "open the faucet"}
            start = time.perf_counter()
            client.send_observation(robot_client.TimedObservation(time.time(), step, seen, True))
            assert client.stub.GetActions(robot_client.services_pb2.Empty()).data
            taken.append(1e3 * (time.perf_counter() - start))
            start = time.perf_counter()
            ours.act(images={"corner4": seen["corner4"]}, state=arm.at, text=seen["task"])
            native.append(1e3 * (time.perf_counter() - start))
    client.stop()
    with capsys.disabled():
        print(f"\nobservation to chunk: p50 {np.median(taken):.2f} ms over gRPC, {np.median(native):.2f} ms natively")


def test_a_robot_with_another_camera_does_not_start(address, monkeypatch):
    arm = Arm()
    arm.observation_features = {**{f"{m}.pos": float for m in MOTORS}, "roof": (128, 128, 3)}
    client = client_of(address, monkeypatch, arm)
    assert not client.start()
    client.stop()

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""An episode with the robot_client of LeRobot, its two threads and its queue: lerobot_robot.py HOST:PORT ROWS

The queue runs empty before the robot looks again, and the first row of a chunk that follows another is at a time that is over: the
client leaves it out.
"""
import sys
import threading

from vla_cpp.eval import lerobot_reference  # noqa: F401, I001  (before lerobot: for Python 3.11, and offline)

from lerobot.async_inference import robot_client
from lerobot.async_inference.configs import RobotClientConfig
from lerobot.robots import RobotConfig
from robot import Robot


class Config(RobotConfig):
    pass


class Arm:
    """LeRobot's interface of a robot."""

    def __init__(self):
        self.robot, self.on_end = Robot(), None
        self.frame, state, self.text = self.robot.observe()
        self.motors = [f"motor_{i}.pos" for i in range(len(state))]
        self.observation_features = {**{motor: float for motor in self.motors}, "corner4": self.frame.shape}
        self.action_features = {motor: float for motor in self.motors}

    def connect(self):
        pass

    disconnect = connect

    def get_observation(self):
        frame, state, _ = self.robot.observe()
        return {**dict(zip(self.motors, state.tolist())), "corner4": frame}

    def send_action(self, action):
        if not self.robot.over:
            self.robot.step([action[motor] for motor in self.motors])
        if self.robot.over:
            self.on_end()
        return action


def main(address, rows):
    arm = Arm()
    robot_client.make_robot_from_config = lambda config: arm
    config = RobotClientConfig(
        policy_type="smolvla", pretrained_name_or_path="not/looked-at", robot=Config(), actions_per_chunk=int(rows) + 1,
        server_address=address, task=arm.text, fps=30, chunk_size_threshold=0,
    )  # fmt: skip
    client = robot_client.RobotClient(config)
    arm.on_end = client.shutdown_event.set
    assert client.start()
    receiver = threading.Thread(target=client.receive_actions, daemon=True)
    receiver.start()
    client.control_loop(task=arm.text)
    client.stop()
    receiver.join()


main(*sys.argv[1:])

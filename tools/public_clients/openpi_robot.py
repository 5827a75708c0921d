# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""An episode with openpi's own client: openpi_robot.py HOST:PORT ROWS [broker]"""
import sys

from openpi_client.websocket_client_policy import WebsocketClientPolicy
from robot import Robot


def main(address, rows, kind="chunks"):
    robot, policy = Robot(), WebsocketClientPolicy(*address.split(":"))
    if kind == "broker":
        from openpi_client.action_chunk_broker import ActionChunkBroker

        policy = ActionChunkBroker(policy, action_horizon=int(rows))
    while not robot.over:
        frame, state, text = robot.observe()
        actions = policy.infer({"observation/image": frame, "observation/state": state, "prompt": text})["actions"]
        if kind == "broker":  # which gives the rows one by one
            robot.step(actions)
            continue
        robot.show(actions)
        for action in actions[: int(rows)]:
            if not robot.over:
                robot.step(action)


main(*sys.argv[1:])

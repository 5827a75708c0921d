# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""An episode with a client of Isaac-GR00T's own tree: gr00t_robot.py HOST:PORT ROWS [n1.5]"""
import importlib
import sys
from unittest import mock

import numpy as np
from robot import Robot


def imported(name):
    """A module of Isaac-GR00T. Packages of training and of the networks, which its clients import and do not use, may be missing."""
    while True:
        try:
            return importlib.import_module(name)
        except ModuleNotFoundError as error:
            if error.name.startswith("gr00t"):
                raise
            sys.modules[error.name] = mock.MagicMock()


def main(address, rows, release="n1.6"):
    host, port = address.split(":")
    is_n1_5 = release == "n1.5"
    module = imported("gr00t.eval.service" if is_n1_5 else "gr00t.policy.server_client")
    policy = (module.ExternalRobotInferenceClient if is_n1_5 else module.PolicyClient)(host=host, port=int(port))
    assert policy.ping()
    modalities = policy.call_endpoint("get_modality_config", requires_input=False)
    keys = {name: modality.modality_keys for name, modality in modalities.items()}
    robot = Robot()
    while not robot.over:
        frame, state, text = robot.observe()
        if is_n1_5:
            seen = {keys["video"][0]: frame[None], keys["state"][0]: state[None], keys["language"][0]: [text]}
            answer = policy.get_action(seen)
        else:
            seen = {"video": {keys["video"][0]: frame[None, None]}, "state": {keys["state"][0]: state[None, None]}}
            answer, _ = policy.get_action({**seen, "language": {keys["language"][0]: [[text]]}})
        chunk = np.concatenate([answer[key].reshape(-1, answer[key].shape[-1]) for key in keys["action"]], axis=1)
        robot.show(chunk)
        for action in chunk[: int(rows)]:
            if not robot.over:
                robot.step(action)


main(*sys.argv[1:])

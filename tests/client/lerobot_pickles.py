# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The messages of LeRobot's robot_client (lerobot 0.6.1, async_inference/helpers.py), pickled without LeRobot: classes of its names.

lerobot_pickles.py FOLDER    writes the seeds of the fuzz target
"""

import io
import pickle
import sys
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

MODULE = "lerobot.async_inference.helpers"


@dataclass
class TimedObservation:
    timestamp: float
    timestep: int
    observation: dict
    must_go: bool = False


@dataclass
class TimedAction:
    timestamp: float
    timestep: int
    action: object


@dataclass
class RemotePolicyConfig:
    policy_type: str
    pretrained_name_or_path: str
    lerobot_features: dict
    actions_per_chunk: int
    device: str = "cpu"
    rename_map: dict = field(default_factory=dict)


class Pickler(pickle._Pickler):  # the one in Python, whose table of functions can be added to
    def save_global(self, obj, name=None):
        if obj in (TimedObservation, TimedAction, RemotePolicyConfig):
            self.save(self.module), self.save(obj.__name__)
            return self.write(pickle.STACK_GLOBAL)
        return super().save_global(obj, name)

    dispatch = {**pickle._Pickler.dispatch, type: save_global}


def dumps(value, protocol=4, module=MODULE):
    file = io.BytesIO()
    pickler = Pickler(file, protocol)
    pickler.module = module
    pickler.dump(value)
    return file.getvalue()


class Unpickler(pickle.Unpickler):
    def find_class(self, module, name):
        found = {"TimedAction": TimedAction, "FloatTensor": lambda values: np.array(values, np.float32)}
        assert (module, name) in {(MODULE, "TimedAction"), ("torch", "FloatTensor")}, (module, name)
        return found[name]


def loads(data):
    return Unpickler(io.BytesIO(data)).load()


def features_of(motors, cameras):
    state = {"observation.state": {"dtype": "float32", "shape": (len(motors),), "names": list(motors)}}
    image = {
        "dtype": "image",
        "shape": (16, 16, 3),
        "names": ["height", "width", "channels"],
        "info": {"is_depth_map": False},
    }
    return {**state, **{f"observation.images.{camera}": image for camera in cameras}}


def setup_of(motors, cameras, actions_per_chunk=50, policy_type="smolvla"):
    return RemotePolicyConfig(policy_type, "some/checkpoint", features_of(motors, cameras), actions_per_chunk)


class Bomb:
    def __reduce__(self):
        return Path.touch, (Path("/tmp/vla-pickle-bomb"),)


def main(folder):
    frame = np.arange(48, dtype=np.uint8).reshape(4, 4, 3)
    motors = ["arm.0", "arm.1", "hand"]
    seen = {
        "arm.0": 1.5,
        "arm.1": np.float32(2.5),
        "hand": np.float64(-1),
        "image": frame,
        "wrist": frame,
        "task": "go",
    }
    observation = TimedObservation(1.7e9, 3, seen, True)
    seeds = {
        "setup": dumps(setup_of(motors, ["image", "wrist"])),
        "observation": dumps(observation),
        "observation_p5": dumps(observation, 5),
        "observation_old": dumps(observation, 4, "lerobot.scripts.server.helpers"),
        "observation_p2": dumps(TimedObservation(1.0, 0, {"arm.0": 1, "arm.1": 2**40, "hand": True, "task": "go"}), 2),
        "bomb": dumps({"a": Bomb()}),
        "half": dumps({"arm.0": np.float16(0.5)}),
    }
    floats = np.linspace(0, 1, 48).reshape(4, 4, 3)
    arrays = {
        "frame_f2": floats.astype(np.float16),
        "frame_f4": floats.astype(np.float32),
        "frame_f4_big": floats.astype(">f4"),
        "frame_f8": floats,
        "frame_i8": frame.astype(np.int64),
        "frame_fortran": np.asfortranarray(frame),
    }
    for name, array in arrays.items():
        seeds[name] = dumps(TimedObservation(1.7e9, 3, {**seen, "image": array}, True))
    for name, data in seeds.items():
        (Path(folder) / name).write_bytes(data)


if __name__ == "__main__":
    main(*sys.argv[1:])

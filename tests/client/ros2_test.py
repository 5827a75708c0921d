# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""examples/ros2/conversions.py, with plain objects and, where rosbags is installed, with the messages of ROS 2 as they go over a wire."""

import sys
from pathlib import Path
from types import SimpleNamespace as Message

import numpy as np
import pytest

import vla_cpp

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / "examples/ros2"))

from conversions import Refused, image_of, stamp_ns, state_of, trajectory_of  # noqa: E402

PNG = b"\x89PNG\r\n\x1a\n and more"
BUNDLE = vla_cpp.BundleInfo("x.gguf", "smolvla", "xxh3:0", "")
CHUNK = vla_cpp.Chunk(np.arange(12, dtype=np.float32).reshape(4, 3), ("a.pos", "b.pos", "gripper"), 30.0, BUNDLE)


def raw(encoding="rgb8", step=8, extra=b""):
    """Two pixels beside each other in each of two rows, which end with two bytes of padding."""
    data = bytes(range(6)) + b"xx" + bytes(range(6, 12)) + b"xx" + extra
    return Message(encoding=encoding, height=2, width=2, step=step, data=data)


def test_compressed_images_stay_files():
    assert image_of(Message(format="rgb8; jpeg compressed bgr8", data=b"\xff\xd8\xff rest")) == b"\xff\xd8\xff rest"
    assert image_of(Message(format="png", data=memoryview(PNG))) == PNG
    with pytest.raises(Refused, match="found format 'h264'"):
        image_of(Message(format="h264", data=b"\0\0\0\1"))


def test_raw_images_are_rgb_without_padding():
    rgb = np.arange(12, dtype=np.uint8).reshape(2, 2, 3)
    assert np.array_equal(image_of(raw()), rgb)
    assert np.array_equal(image_of(raw("bgr8")), rgb[..., ::-1])
    for bad in (raw("mono8"), raw("16UC1"), raw(step=4), raw(extra=b"x")):
        with pytest.raises(Refused):
            image_of(bad)


def test_a_state_has_the_order_that_is_asked_for():
    joints = Message(name=["wrist", "elbow", "other"], position=[1.0, 2.0, 3.0])
    assert state_of(joints, ["elbow", "wrist"]).tolist() == [2.0, 1.0]
    with pytest.raises(Refused, match="none for shoulder"):
        state_of(joints, ["shoulder", "elbow"])
    with pytest.raises(Refused):
        state_of(Message(name=["a", "b"], position=[1.0]), ["a"])
    with pytest.raises(Refused, match="finite"):
        state_of(Message(name=["a"], position=[float("nan")]), ["a"])


def test_a_trajectory_has_the_columns_of_its_joints_at_the_policys_rate():
    message = trajectory_of(CHUNK, {"b.pos": "B", "a.pos": "A"}, Message, Message, Message, first=1)
    assert message.joint_names == ["B", "A"]
    assert [p.positions for p in message.points] == [[4, 3], [7, 6], [10, 9]]
    times = [p.time_from_start.sec * 10**9 + p.time_from_start.nanosec for p in message.points]
    assert times == [33_333_333, 66_666_667, 100_000_000]
    slow = vla_cpp.Chunk(CHUNK.actions, CHUNK.names, 0.4, BUNDLE)
    assert trajectory_of(slow, {"a.pos": "A"}, Message, Message, Message).points[0].time_from_start == Message(sec=2, nanosec=500_000_000)


@pytest.mark.parametrize("joints, first, rate", [({"c.pos": "C"}, 0, 30.0), ({"a.pos": "A"}, 4, 30.0), ({"a.pos": "A"}, 0, 0.0)])
def test_a_trajectory_that_would_be_guessed_is_refused(joints, first, rate):
    with pytest.raises(Refused):
        trajectory_of(vla_cpp.Chunk(CHUNK.actions, CHUNK.names, rate, BUNDLE), joints, Message, Message, Message, first=first)


def test_messages_of_ros_2_are_taken_and_made():
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    types = {name.rsplit("/", 1)[-1]: kind for name, kind in store.types.items()}

    def wired(message):
        return store.deserialize_cdr(store.serialize_cdr(message, message.__msgtype__), message.__msgtype__)

    header = types["Header"](stamp=types["Time"](sec=3, nanosec=4), frame_id="top")
    assert stamp_ns(wired(header)) == 3_000_000_004
    assert image_of(wired(types["CompressedImage"](header=header, format="png", data=np.frombuffer(PNG, np.uint8)))) == PNG
    plain = raw()
    image = types["Image"](header=header, height=2, width=2, encoding="bgr8", is_bigendian=0, step=8, data=np.frombuffer(plain.data, np.uint8))
    assert np.array_equal(image_of(wired(image)), image_of(raw("bgr8")))
    none = np.array([], np.float64)
    joints = types["JointState"](header=header, name=["a", "b"], position=np.array([1.0, 2.0]), velocity=none, effort=none)
    assert state_of(wired(joints), ["b", "a"]).tolist() == [2.0, 1.0]

    def point():
        return types["JointTrajectoryPoint"](none, none, none, none, types["Duration"](0, 0))

    made = trajectory_of(CHUNK, {"a.pos": "A"}, lambda: types["JointTrajectory"](header, [], []), point, types["Duration"])
    for entry in made.points:
        entry.positions = np.array(entry.positions)
    back = wired(made)
    assert back.joint_names == ["A"] and [p.positions.tolist() for p in back.points] == [[0], [3], [6], [9]]
    assert back.points[3].time_from_start.nanosec == 133_333_333

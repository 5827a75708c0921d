# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Messages of ROS 2 to what `vla_cpp.Client.act` takes, and a chunk to a trajectory. README.md shows a node that uses them.

Nothing here imports ROS: messages are taken by their fields, and made by the classes that are given.
"""

import numpy as np

CHANNELS = {"rgb8": (0, 1, 2), "bgr8": (2, 1, 0)}  # encodings of sensor_msgs/Image that are taken


class Refused(ValueError):
    """A message that would have to be guessed at."""


def stamp_ns(header):
    """A header's time in nanoseconds, for capture_time_ns."""
    return header.stamp.sec * 10**9 + header.stamp.nanosec


def image_of(message):
    """Of a sensor_msgs CompressedImage the bytes of its JPEG or PNG file; of an Image uint8 (height, width, 3) RGB."""
    if not hasattr(message, "encoding"):
        data = bytes(message.data)
        if data.startswith((b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n")):
            return data
        raise Refused(f"CompressedImage: expected the bytes of a JPEG or PNG file, found format {message.format!r}")
    if message.encoding not in CHANNELS:
        raise Refused(f"Image: expected the encoding {' or '.join(CHANNELS)}, found {message.encoding!r}")
    rows = np.frombuffer(bytes(message.data), np.uint8)
    if message.step < 3 * message.width or rows.size != message.height * message.step:
        raise Refused(f"Image: expected {message.height} rows of {message.step} bytes, found {rows.size} bytes")
    pixels = rows.reshape(message.height, message.step)[:, : 3 * message.width].reshape(message.height, message.width, 3)
    return np.ascontiguousarray(pixels[..., CHANNELS[message.encoding]])


def state_of(message, joints):
    """Positions of a sensor_msgs JointState in the order of `joints`, which need not be the message's: float32, in its units (rad, m)."""
    position = dict(zip(message.name, message.position))
    missing = [joint for joint in joints if joint not in position]
    if missing or len(message.name) != len(message.position):
        raise Refused(f"JointState: expected a position for each of {', '.join(joints)}, found none for {', '.join(missing) or 'some names'}")
    values = np.array([position[joint] for joint in joints], np.float32)
    if not np.isfinite(values).all():
        raise Refused("JointState: expected finite positions")
    return values


def trajectory_of(chunk, joints, trajectory, point, duration, first=0):
    """A trajectory_msgs JointTrajectory of the chunk's rows from `first` on, the first of them due one control step from its start.

    joints                       the joint that each column moves to: {column's name: joint}; columns that are not here (a gripper with an
                                 action of its own) are left out
    trajectory, point, duration  the classes JointTrajectory, JointTrajectoryPoint and Duration

    For actions that are absolute positions. A controller interpolates between the points.
    """
    if not chunk.rate_hz > 0:
        raise Refused("chunk: expected rows a second, but its bundle states none")
    unknown = [name for name in joints if name not in chunk.names]
    if unknown or not 0 <= first < len(chunk):
        raise Refused(f"chunk: expected columns {', '.join(joints)} and row {first}, found {', '.join(chunk.names)} and {len(chunk)} rows")
    columns = [chunk.names.index(name) for name in joints]
    message = trajectory()
    message.joint_names = list(joints.values())
    message.points = []
    for i, row in enumerate(np.asarray(chunk)[first:]):
        at = round((i + 1) * 1e9 / chunk.rate_hz)
        entry = point()
        entry.positions = [float(row[column]) for column in columns]
        entry.time_from_start = duration(sec=at // 10**9, nanosec=at % 10**9)
        message.points.append(entry)
    return message

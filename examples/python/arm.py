#!/usr/bin/env python3
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""An arm of one's own: a policy drives it within limits, a person takes over, and episodes keep both (docs/robots.md).

    python arm.py tcp://127.0.0.1:5555 limits.json --arm simulated --camera front= --text "pick up the cube" --speed 0.1 --seconds 20
    python arm.py tcp://127.0.0.1:5555 limits.json --arm so101 --port /dev/ttyACM0 --id arm --camera front=/dev/video0 \\
        --leader /dev/ttyACM1 --text "pick up the cube" --speed 0.1 --seconds 20 --episodes episodes

Lines on standard input: t takes over and gives back; s ends the episode with success, f with failure, q without a word. Needs
vla_cpp; for so101 also lerobot[feetech]. The cameras of the simulated arm show noise.
"""

import argparse
import contextlib
import select
import sys
from dataclasses import replace

import numpy as np

import vla_cpp
from vla_cpp.control import ChunkLoop, EpisodeWriter, Limits

WIDTH, HEIGHT, FPS = 640, 480, 30


class Simulated:
    """Motors that go towards their command, and a leader that rests where they began."""

    def __init__(self, args, names):
        self.joints = np.zeros(len(names)) if args.start is None else np.array(args.start)
        self.rest = self.joints.copy()
        self.random, self.cameras = np.random.default_rng(0), list(args.cameras)

    def observe(self):
        return self.joints.tolist(), {camera: self.random.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8) for camera in self.cameras}

    def command(self, values):
        self.joints += 0.5 * (values - self.joints)

    def leader(self):
        return self.rest

    def close(self):
        pass


class So101:
    """LeRobot's SO-101, and its leader arm where there is one."""

    def __init__(self, args, names):
        from lerobot.cameras.opencv import OpenCVCameraConfig
        from lerobot.robots.so_follower import SO101Follower, SO101FollowerConfig
        from lerobot.teleoperators.so_leader import SO101Leader, SO101LeaderConfig

        cameras = {name: OpenCVCameraConfig(index_or_path=device, fps=FPS, width=WIDTH, height=HEIGHT) for name, device in args.cameras.items()}
        self.names = names
        # Motors that lose their torque let the arm fall: it stays where it is until its power is taken away.
        self.arm = SO101Follower(SO101FollowerConfig(port=args.port, id=args.id, cameras=cameras, disable_torque_on_disconnect=False))
        self.arm.connect()
        self._leader = SO101Leader(SO101LeaderConfig(port=args.leader, id=args.id)) if args.leader else None
        if self._leader:
            self._leader.connect()
        self.cameras = list(args.cameras)

    def observe(self):
        seen = self.arm.get_observation()
        return [seen[name] for name in self.names], {camera: seen[camera] for camera in self.cameras}

    def command(self, values):
        self.arm.send_action(dict(zip(self.names, map(float, values))))

    def leader(self):
        if not self._leader:
            raise vla_cpp.UsageError("t", "--leader PORT, with which a person drives", "none")
        told = self._leader.get_action()
        return [told[name] for name in self.names]

    def close(self):
        self.arm.disconnect()
        if self._leader:
            self._leader.disconnect()


def slower(limits, speed):
    """The limits of a motion that takes 1 / speed times as long."""
    def column(c):
        most = [None if v is None else v * speed**n for n, v in enumerate((c.velocity, c.acceleration, c.jerk), 1)]
        return replace(c, velocity=most[0], acceleration=most[1], jerk=most[2])

    return Limits(tuple(map(column, limits.columns)), limits.refuse_above)


def said():
    """A line that a person typed, or nothing."""
    return sys.stdin.readline().strip() if select.select([sys.stdin], [], [], 0)[0] else ""


def drive(args, policy):
    spec = policy.spec
    (state,) = spec.states
    rate_hz = (args.rate_hz or spec.rate_hz) * args.speed
    arm = (Simulated if args.arm == "simulated" else So101)(args, spec.action_names)
    limits = slower(Limits.read(args.limits), args.speed)
    loop = ChunkLoop(policy, rate_hz=rate_hz, mode="async", blend="linear", fade_steps=2, on_late="hold", on_note="warn", limits=limits, allow_other_rate=True, replan_every=args.replan_every)  # fmt: skip
    success = None

    def observe():
        joints, frames = arm.observe()
        return dict(images=frames, state={state.name: joints}, text=args.text)

    recorded = EpisodeWriter(args.episodes, spec, rate_hz=rate_hz) if args.episodes else contextlib.nullcontext()
    with loop, recorded as episodes:
        if episodes:
            episodes.begin(args.text)
        try:
            loop.start_at(arm.observe()[0])
            loop.begin(observe())
            for tick in range(round(args.seconds * rate_hz)):
                word = said()
                if word == "t":
                    loop.give_back("person") if loop.driver else loop.take_over("person")
                if word in ("s", "f", "q"):
                    success = {"s": True, "f": False, "q": None}[word]
                    break
                seen = observe()
                action = loop.step(seen, human=arm.leader() if loop.driver else None)
                if action.values is not None:
                    arm.command(action.values)
                if episodes:
                    episodes.add(seen, action)
                if tick % max(1, round(rate_hz)) == 0:
                    who = "person" if action.human else "held  " if action.held else "policy"
                    cut = f", cut: {', '.join(spec.action_names[i] for i in action.clamped)}" if action.clamped else ""
                    print(f"{tick / rate_hz:5.1f} s  {who}  chunks {loop.stats['chunks']}, late {loop.stats['held']}{cut}", flush=True)
                loop.pace()
        finally:
            if episodes:
                episodes.end(success)
            arm.close()


def arguments():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("policy", help="tcp://HOST:PORT of vla serve")
    parser.add_argument("limits", help="what the robot may do: vla-limits suggest")
    parser.add_argument("--arm", choices=("simulated", "so101"), required=True)
    parser.add_argument("--port", help="of so101: the serial port of the arm")
    parser.add_argument("--id", help="of so101: the name of its calibration")
    parser.add_argument("--leader", metavar="PORT", help="of so101: the arm with which a person takes over")
    parser.add_argument("--start", type=lambda text: [float(x) for x in text.split(",")], metavar="v,v,...", help="of simulated: where it begins; zeros")
    parser.add_argument("--camera", action="append", default=[], metavar="VIEW=DEVICE", help="a view of the policy, and the camera that feeds it")
    parser.add_argument("--text", required=True, help="the instruction")
    parser.add_argument("--speed", type=float, required=True, help="1 is that of the demonstrations; begin with 0.1")
    parser.add_argument("--rate-hz", type=float, help="of the demonstrations, where the bundle does not say it")
    parser.add_argument("--replan-every", type=int, help="rows; where the bundle does not say it")
    parser.add_argument("--seconds", type=float, required=True)
    parser.add_argument("--episodes", metavar="DIR", help="a new episode goes in here; all of a folder have one speed")
    args = parser.parse_args()
    args.cameras = dict(pair.partition("=")[::2] for pair in args.camera)
    if not 0 < args.speed <= 1:
        parser.error("--speed: expected above 0, 1 at most")
    if args.arm == "so101" and not (args.port and args.id):
        parser.error("--arm so101: expected --port and --id")
    return args


if __name__ == "__main__":
    try:
        given = arguments()
        with vla_cpp.Client(given.policy) as client:
            drive(given, client)
    except (vla_cpp.VlaError, OSError) as error:
        sys.exit(f"error: {error}")

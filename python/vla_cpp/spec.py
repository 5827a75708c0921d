# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""A policy's inputs and outputs, as stated in its bundle."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Mapping, Sequence, Tuple

from .printable import printable


@dataclass(frozen=True)
class ViewSpec:
    """A camera.

    width, height  pixels of the network's input; frames of any size are fitted into it
    camera         width and height of the camera frames that the checkpoint states; 0 where it states none, and always 0 from `Policy`.
                   Not compared by `==`
    """

    name: str
    optional: bool
    width: int
    height: int
    aliases: Tuple[str, ...] = ()
    camera: Tuple[int, int] = field(default=(0, 0), compare=False)


@dataclass(frozen=True)
class StateSpec:
    """A state vector of `width` numbers.

    units, names  one text per number, empty where the bundle does not state it; never guessed
    """

    name: str
    width: int
    units: Tuple[str, ...] = ()
    names: Tuple[str, ...] = ()


@dataclass(frozen=True)
class BundleInfo:
    """The weights that answer.

    name      file name, without folders
    checksum  of the file: "xxh3:" and 16 hexadecimal digits
    source    the converted checkpoint, followed by @ and its revision if known; empty where unknown
    """

    name: str
    arch: str
    checksum: str
    source: str


@dataclass(frozen=True)
class Spec:
    """The inputs and outputs of `act`.

    min_views     least number of views that must be present
    action_units  one text per action, empty where the bundle does not say
    horizon       rows of a chunk
    d_action      columns of a chunk
    d_noise       columns of the noise
    noise_rows    rows of the noise: `horizon`, or more if the network computes rows that the robot does not get, or if solver steps draw
                  noise: first the rows of the start, then as many rows for each such step
    noise         distribution of the noise, e.g. "normal"
    real_time_chunking  how the policy uses a Leftover: "guided" or "inpainted"; "": it is refused
    embodiment    tag of the robot, where the bundle is for several; else ""
    robots        the Spec of each robot by its tag, for a policy with several. Views, states, actions, horizon and noise are then only in
                  those, and empty here
    rate_hz       rows per second in the training data; 0 where the bundle does not say
    n_action_steps  rows of a chunk that the checkpoint executes before the next observation; 0 where the bundle does not say
    """

    views: Tuple[ViewSpec, ...]
    min_views: int
    states: Tuple[StateSpec, ...]
    action_names: Tuple[str, ...]
    action_units: Tuple[str, ...]
    horizon: int
    d_action: int
    d_noise: int
    noise_rows: int
    noise: str
    rate_hz: float
    bundle: BundleInfo
    precision: str
    kernels: str
    device: str
    real_time_chunking: str = ""
    embodiment: str = ""
    robots: Mapping[str, Spec] = field(default_factory=dict)
    n_action_steps: int = 0

    def __repr__(self) -> str:
        robot = f", robot {self.embodiment}" if self.embodiment else ""
        lines = [f"{self.bundle.name} ({self.bundle.arch}{robot}), {self.precision} on {self.device}"]
        lines += [f"  image   {_view_text(view)}" for view in self.views]
        lines += [f"  state   {s.name}, {s.width} values{_named(s.names, s.units)}" for s in self.states]
        if self.horizon:
            rate = f" at {self.rate_hz:g} Hz" if self.rate_hz else ""
            rate += f", {self.n_action_steps} executed" if self.n_action_steps else ""
            lines.append(f"  action  {self.horizon} rows{rate} of {self.d_action} values{_named(self.action_names, self.action_units)}")
            lines.append(f"  noise   {self.noise}, {self.noise_rows} x {self.d_noise}")
        if self.real_time_chunking:
            lines.append(f"  real-time chunking: {self.real_time_chunking}")
        lines += ["  robot   " + tag for tag in self.robots]
        return "\n".join(map(printable, lines))


def _view_text(view: ViewSpec) -> str:
    return f"{view.name}, seen as {view.width} x {view.height}" + (", optional" if view.optional else "")


def _named(names: Sequence[str], units: Sequence[str]) -> str:
    """Named columns as ": x [m], y [m]", with the units that the bundle states; empty without names."""
    units = units or [""] * len(names)
    texts = [f"{name} [{unit}]" if unit else name for name, unit in zip(names, units) if name]
    return ": " + ", ".join(texts) if texts else ""

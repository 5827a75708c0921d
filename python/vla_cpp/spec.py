# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What a policy takes and gives, as its bundle says it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Mapping, Sequence, Tuple

from .printable import printable


@dataclass(frozen=True)
class ViewSpec:
    """A camera. width, height: pixels that the network sees; frames of any size are letterboxed to it. camera: width and height of the
    frames that the checkpoint states, 0 where it states none or `Policy` describes it: views are equal without it."""

    name: str
    optional: bool
    width: int
    height: int
    aliases: Tuple[str, ...] = ()
    camera: Tuple[int, int] = field(default=(0, 0), compare=False)


@dataclass(frozen=True)
class StateSpec:
    """A state vector of `width` numbers.

    units, names: one text per number, empty where the bundle does not say; never guessed
    """

    name: str
    width: int
    units: Tuple[str, ...] = ()
    names: Tuple[str, ...] = ()


@dataclass(frozen=True)
class BundleInfo:
    """Which weights answered.

    name      file name, without folders
    checksum  of the file: "xxh3:" and 16 hexadecimal digits
    source    the checkpoint that was converted, and after an @ its revision; empty where unknown
    """

    name: str
    arch: str
    checksum: str
    source: str


@dataclass(frozen=True)
class Spec:
    """What `act` takes and what it returns.

    min_views     how many views must be present at least
    action_units  one text per action, empty where the bundle does not say
    horizon       rows of a chunk
    d_action      columns of a chunk
    d_noise       columns of the noise
    noise_rows    its rows: `horizon`, or more where the robot gets some rows only of what the network computes, or where steps of
                  the solver draw too: then the start comes first, and behind it as many rows for each of these steps
    noise         its distribution, e.g. "normal"
    real_time_chunking  what a Leftover does: "guided", "inpainted", or "" where it is refused
    embodiment    tag of the robot, where the bundle is for several; else ""
    robots        of a policy with several: each one's own Spec by its tag. Views, states, actions, horizon and noise are then theirs
                  alone, and empty here
    rate_hz       rows per second that the policy was trained for; 0 where the bundle does not say
    n_action_steps  rows of a chunk that the checkpoint executes before it looks again; 0 where the bundle does not say
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
    """": x [m], y [m]" of what has names; units only where the bundle says them."""
    units = units or [""] * len(names)
    texts = [f"{name} [{unit}]" if unit else name for name, unit in zip(names, units) if name]
    return ": " + ", ".join(texts) if texts else ""

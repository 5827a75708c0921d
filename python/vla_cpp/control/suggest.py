# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""vla-limits: suggests limits for a policy's actions from data about the robot, or checks a file of limits."""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Dict, List, Mapping, Optional, Sequence, Tuple

import numpy as np

from ..errors import IoError, UsageError, VlaError
from ..program import candidates
from ..spec import BundleInfo, Spec
from .episodes import Episode, episodes_of
from .limits import KINDS, Column, Limits, gripper

EPILOG = """examples:
  vla-limits suggest policy.gguf --kind position --urdf arm.urdf --refuse-above 0.3 -o limits.json
  vla-limits suggest policy.gguf --kind position --kind gripper=gripper --episodes episodes --margin 1.2 --refuse-above 0.3 -o limits.json
  vla-limits suggest policy.gguf --kind difference --statistics --margin 1.5 --refuse-above 0.3 -o limits.json
  vla-limits check limits.json policy.gguf
A first file is a place to start from: read it, and tighten it. Exit codes: 0 done, 2 usage or limits of another robot, 9 a file."""
CODES = {"usage": 2, "io": 9, "bad_request": 9}
MAX_URDF = 16 << 20  # bytes
FEW_VALUES, MANY_COMMANDS = 3, 20  # a column with at most 3 values in 20 or more commands is not a joint
N_STD = 4.0  # standard deviations from the mean to each end of a range, if a bundle has no better statistics
RADIANS, DEGREES, METRES = ("rad", "radian", "radians"), ("deg", "degree", "degrees"), ("m", "metre", "metres", "meter", "meters")


def build_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser("vla-limits", description=__doc__, epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    suggest = commands.add_parser("suggest", help="write a first file", epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter)
    suggest.add_argument("bundle", type=Path, help="the policy, whose actions are limited")
    suggest.add_argument("--kind", action="append", required=True, metavar="[ACTION=]KIND", help=f"what an action is: {', '.join(KINDS)}; alone for all that have no own")
    source = suggest.add_mutually_exclusive_group(required=True)
    source.add_argument("--urdf", type=Path, metavar="FILE", help="ranges and velocities of the robot's joints")
    source.add_argument("--episodes", type=Path, metavar="DIR", help="what EpisodeWriter wrote: the largest of what was commanded, times the margin")
    source.add_argument("--statistics", action="store_true", help=f"those of the training data in the bundle: ranges alone, of the extremes, or of quantiles, or of {N_STD:g} deviations; times the margin")
    suggest.add_argument("--joint", action="append", default=[], metavar="ACTION=JOINT", help="of --urdf: the joint of an action of another name")
    suggest.add_argument("--margin", type=float, metavar="X", help="of --episodes and --statistics: 1 or more")
    suggest.add_argument("--refuse-above", type=float, required=True, metavar="SHARE", help="share of a chunk's rows that may break a limit before the chunk is refused")
    suggest.add_argument("-o", "--output", type=Path, required=True, metavar="FILE")
    check = commands.add_parser("check", help="compare a file with a policy, and show it")
    check.add_argument("limits", type=Path)
    check.add_argument("bundle", type=Path)
    return parser


def bundle_of(path: Path) -> Tuple[Spec, Dict[str, List[float]]]:
    """A bundle's actions and rate, and the statistics of its training data, from `vla inspect`."""
    program = next((each for each in candidates() if each.is_file()), None)
    if program is None:
        raise IoError("vla", " or ".join(map(str, candidates())), "no such file")
    done = subprocess.run([str(program), "inspect", str(path), "--json"], capture_output=True, text=True)
    if done.returncode:
        raise UsageError(str(path), "a bundle that the runtime opens", done.stderr.strip())
    told = json.loads(done.stdout)
    keys = told["keys"]
    names, units = tuple(keys.get("action.names", ())), tuple(keys.get("action.units", ()))
    spec = Spec(
        views=(), min_views=0, states=(), action_names=names, action_units=units, horizon=0, d_action=len(names), d_noise=0, noise_rows=0,
        noise="", rate_hz=float(keys.get("action.rate_hz", 0)), bundle=BundleInfo(path.name, "", "", ""), precision="", kernels="", device="",
    )  # fmt: skip
    return spec, told["stats"]


def kinds_of(given: Sequence[str], spec: Spec) -> Dict[str, str]:
    """The kind of each action. Errors: UsageError for an action without a kind, or with two."""
    own: Dict[str, str] = {}
    for text in given:
        name, _, kind = text.rpartition("=")
        if kind not in KINDS or (name and name not in spec.action_names) or name in own:
            raise UsageError("--kind", f"KIND or ACTION=KIND, each once, of {', '.join(KINDS)} and {', '.join(spec.action_names)}", text)
        own[name] = kind
    missing = [name for name in spec.action_names if name not in own and "" not in own]
    if missing:
        raise UsageError("--kind", f"the kind of {', '.join(missing)}", "none")
    return {name: own.get(name, own.get("", "")) for name in spec.action_names}


def of_urdf(path: Path, spec: Spec, kinds: Mapping[str, str], given: Sequence[str]) -> List[Column]:
    """The range and the velocity of each action's joint. Errors: IoError; UsageError for a joint that is missing or has no limit."""
    joints = read_urdf(path)
    renamed = dict(_pair("--joint", text) for text in given)
    extra = [name for name in renamed if name not in spec.action_names]
    if extra:
        raise UsageError("--joint", f"actions of {spec.bundle.name}: {', '.join(spec.action_names)}", ", ".join(extra))
    columns = []
    for i, name in enumerate(spec.action_names):
        if kinds[name] == "gripper" and name not in renamed:  # the unit of its action is rarely that of the joint
            columns.append(Column(name, "gripper", spec.action_units[i] if spec.action_units else ""))
            continue
        joint = renamed.get(name, name[: -len(".pos")] if name.endswith(".pos") else name)
        if joint not in joints:
            hint = f"--joint {name}=JOINT for a joint of another name"
            raise UsageError(str(path), f"a joint {joint}, one of {', '.join(joints)}", "none", hint)
        columns.append(_column(path, name, kinds[name], spec.action_units[i] if spec.action_units else "", joints[joint]))
    return columns


def read_urdf(path: Path) -> Dict[str, Tuple[str, Dict[str, float]]]:
    """Type and limits of each joint that moves independently. Errors: IoError for a file that is not a URDF."""
    try:
        if not path.is_file() or path.stat().st_size > MAX_URDF:
            raise ValueError(f"no regular file of at most {MAX_URDF} bytes")
        text = path.read_bytes()
        if b"<!DOCTYPE" in text or b"<!ENTITY" in text:
            raise ValueError("a document that defines entities")
        root = ElementTree.fromstring(text)
        if root.tag != "robot":
            raise ValueError(f"an element {root.tag[:40]}")
        return {joint.attrib["name"]: _joint(joint) for joint in root.findall("joint") if joint.get("type") in ("revolute", "prismatic", "continuous") and joint.find("mimic") is None}
    except (OSError, ValueError, KeyError, ElementTree.ParseError) as problem:
        raise IoError(str(path), "a URDF: an element robot with joints", str(problem)) from None


def _joint(joint: ElementTree.Element) -> Tuple[str, Dict[str, float]]:
    limit = joint.find("limit")
    found = {key: float(limit.attrib[key]) for key in ("lower", "upper", "velocity") if limit is not None and key in limit.attrib}
    if not all(math.isfinite(value) for value in found.values()):
        raise ValueError(f"joint {joint.attrib['name']}: a limit that is not finite")
    return joint.attrib["type"], found


def _column(path: Path, name: str, kind: str, unit: str, joint: Tuple[str, Dict[str, float]]) -> Column:
    type_, limit = joint
    is_turning, low_unit = type_ != "prismatic", unit.lower()
    known = (RADIANS + DEGREES) if is_turning else METRES
    if low_unit and low_unit not in known:
        raise UsageError(str(path), f"a joint in {unit}, as the bundle says {name} is", f"{type_}, in {'radians' if is_turning else 'metres'}")
    scale = 180 / math.pi if low_unit in DEGREES else 1.0
    is_ranged, has_velocity = kind in ("position", "gripper") and type_ != "continuous", kind != "gripper"
    if (is_ranged and not {"lower", "upper"} <= set(limit)) or (has_velocity and not limit.get("velocity", 0) > 0):
        raise UsageError(f"{path}: joint of {name}", "a limit with lower, upper and velocity", str(limit) if limit else "none")
    low, high = (scale * limit["lower"], scale * limit["upper"]) if is_ranged else (None, None)
    return Column(name, kind, unit, low, high, velocity=scale * limit["velocity"] if has_velocity else None)


def of_statistics(stats: Mapping[str, Sequence[float]], spec: Spec, kinds: Mapping[str, str], margin: float) -> Tuple[List[Column], str]:
    """Ranges from the bundle's statistics, and the names of these statistics. Errors: UsageError if the bundle has none."""
    found = {key.rsplit(".", 1)[-1]: values for key, values in stats.items() if key.startswith("stats.action.") and len(values) == spec.d_action}
    for low, high in (("min", "max"), ("q01", "q99"), ("q02", "q98"), ("q10", "q90")):
        if low in found and high in found:
            ends, told = (np.array(found[low], float), np.array(found[high], float)), f"{low} and {high}"
            break
    else:
        if "mean" not in found or "std" not in found:
            raise UsageError("--statistics", f"statistics of the {spec.d_action} actions", ", ".join(stats) or "none")
        mean, std = np.array(found["mean"], float), np.array(found["std"], float)
        ends, told = (mean - N_STD * std, mean + N_STD * std), f"mean and {N_STD:g} deviations"
    columns = []
    for i, name in enumerate(spec.action_names):
        if kinds[name] == "gripper":
            columns.append(gripper(name, spec.action_units[i] if spec.action_units else "", float(ends[0][i]), float(ends[1][i])))
            continue
        grown = (margin - 1) / 2 * (ends[1][i] - ends[0][i])
        low, high = float(ends[0][i] - grown), float(ends[1][i] + grown)
        if kinds[name] != "position":
            low, high = min(low, 0.0), max(high, 0.0)  # 0 must be permitted, so that the robot can stop
        columns.append(Column(name, kinds[name], spec.action_units[i] if spec.action_units else "", low, high))
    return columns, told


def suggest(a: argparse.Namespace) -> None:
    spec, stats = bundle_of(a.bundle)
    if not spec.action_names or not all(spec.action_names):
        raise UsageError(str(a.bundle), "a policy whose actions have names", "one without", "vla-convert --action-names gives them")
    kinds = kinds_of(a.kind, spec)
    if (a.margin is None) != (a.urdf is not None) or (a.margin is not None and not 1 <= a.margin < math.inf):
        raise UsageError("--margin", "1 or more with --episodes or --statistics, and only there", str(a.margin))
    if a.joint and not a.urdf:
        raise UsageError("--joint", "--urdf beside it", "none")
    if a.urdf:
        limits, told = Limits(tuple(of_urdf(a.urdf, spec, kinds, a.joint)), a.refuse_above), str(a.urdf)
    elif a.statistics:
        columns, told = of_statistics(stats, spec, kinds, a.margin)
        limits = Limits(tuple(columns), a.refuse_above)
    else:
        limits, told = of_episodes(a.episodes, spec, kinds, a.margin, a.refuse_above), str(a.episodes)
    limits.write(a.output)
    print(f"{a.output}: {len(limits.columns)} actions, from {told}")
    show(limits)


def of_episodes(folder: Path, spec: Spec, kinds: Mapping[str, str], margin: float, refuse_above: float) -> Limits:
    """The widest limits over all episodes' commands. Errors: UsageError for episodes of other actions."""
    found: List[Limits] = []
    commands: List[np.ndarray] = []
    for episode in episodes_of(folder):
        if episode.header.action_names != spec.action_names:
            raise UsageError(str(episode.folder), f"the actions of {spec.bundle.name}: {', '.join(spec.action_names)}", ", ".join(episode.header.action_names))
        for rows in _runs(episode):
            commands.append(rows)
            found.append(Limits.suggest(spec, kinds, rows, episode.header.rate_hz, margin=margin, refuse_above=refuse_above))
    if not found:
        raise UsageError(str(folder), "an episode of four commands or more", "none")
    _check_joints(folder, spec, kinds, np.concatenate(commands))
    return Limits(tuple(_widest([each.columns[i] for each in found]) for i in range(spec.d_action)), refuse_above)


def _check_joints(folder: Path, spec: Spec, kinds: Mapping[str, str], commands: np.ndarray) -> None:
    """Refuses a position that jumps between a few values, since its velocity limit would permit any motion. Errors: UsageError."""
    for i, name in enumerate(spec.action_names):
        values = np.unique(commands[:, i])
        if kinds[name] == "position" and 2 <= len(values) <= FEW_VALUES and len(commands) >= MANY_COMMANDS:
            found = f"{', '.join(f'{value:g}' for value in values)} alone in {len(commands)} commands"
            raise UsageError(f"{folder}: {name}", "a joint that moves", found, f"--kind {name}=gripper for one that opens and closes")


def _runs(episode: Episode) -> List[np.ndarray]:
    """The runs of four or more commands in consecutive control periods."""
    ticks, rows = [], []
    for frame in episode:
        if not np.isnan(frame["action"]).any():
            ticks.append(int(frame["tick"]))
            rows.append(frame["action"].copy())
    breaks = [i for i in range(1, len(ticks)) if ticks[i] != ticks[i - 1] + 1]
    return [np.array(rows[first:end]) for first, end in zip([0, *breaks], [*breaks, len(rows)]) if end - first >= 4]


def _widest(columns: Sequence[Column]) -> Column:
    def most(field: str) -> Optional[float]:
        return max((getattr(c, field) for c in columns if getattr(c, field) is not None), default=None)

    first = columns[0]
    low = min((c.low for c in columns if c.low is not None), default=None)
    return Column(first.name, first.kind, first.unit, low, most("high"), most("velocity"), most("acceleration"), most("jerk"))


def check(a: argparse.Namespace) -> None:
    show(Limits.read(a.limits).of(bundle_of(a.bundle)[0]))


def show(limits: Limits) -> None:
    def number(value: Optional[float]) -> str:
        return "-" if value is None else f"{value:.4g}"

    rows = [("action", "kind", "unit", "least", "largest", "velocity", "acceleration", "jerk")]
    rows += [(c.name, c.kind, c.unit or "unstated", *(number(getattr(c, f)) for f in ("low", "high", "velocity", "acceleration", "jerk"))) for c in limits.columns]
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    for row in rows:
        print("  ".join(cell.ljust(width) for cell, width in zip(row, widths)).rstrip())


def _pair(option: str, text: str) -> Tuple[str, str]:
    name, _, value = text.partition("=")
    if not name or not value:
        raise UsageError(option, "ACTION=JOINT", text)
    return name, value


def main(argv: Optional[List[str]] = None) -> int:
    a = build_parser().parse_args(argv)
    try:
        {"suggest": suggest, "check": check}[a.command](a)
    except VlaError as error:
        print(f"vla-limits: {error}", file=sys.stderr)
        return CODES.get(error.code, 1)
    except OSError as error:
        print(f"vla-limits: {error}", file=sys.stderr)
        return 9
    return 0


if __name__ == "__main__":
    sys.exit(main())

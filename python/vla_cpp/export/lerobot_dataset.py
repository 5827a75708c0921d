# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Writes LeRobot data sets, with LeRobot's own code. From a server's recording: a frame per chunk, with the chunk's first row as the action.
From a loop's episodes: a frame per control period, with the commanded action."""

from __future__ import annotations

from itertools import tee, zip_longest
from pathlib import Path
from typing import Any, Dict, Iterable, Iterator, List, Optional, Sequence, Tuple

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from ..control.episodes import Episode, Header
from ..errors import BadRequest, UsageError, VlaError
from ..recording import RecordedAct
from .common import column_names, pixels

MAX_OFF = 0.25  # largest relative difference between a frame's duration and the median interval of the acts


def write_lerobot(folder: Path, acts: Iterable[RecordedAct], fps: int, gap_s: float) -> Dict[str, int]:
    """Writes acts; returns the numbers of frames and episodes. Errors: UsageError (nothing to write, or `fps` is not the recorded rate),
    BadRequest (a frame whose views or sizes differ from the first)."""
    starts = _starts(acts, fps, gap_s)
    data: Optional[LeRobotDataset] = None
    try:
        for act, is_start in zip(_answered(acts), starts):
            frame = _frame(act)
            if data is None:
                features = _features(act, frame)
                data = LeRobotDataset.create(folder.name, fps, features, root=folder, use_videos=False)
            elif is_start:
                data.save_episode()
            _check(act, frame, features)
            data.add_frame({**frame, "task": act.text})
        data.save_episode()
    finally:
        if data is not None:
            data.finalize()
    return {"frames": len(starts), "episodes": sum(starts)}


def write_episodes(folder: Path, episodes: Sequence[Episode], only_human: bool) -> Dict[str, int]:
    """Writes episodes; returns the numbers of frames and episodes. Periods without a command are left out. With `only_human` each run of
    periods that a person commanded is an episode. Beside the features that LeRobot's policies read, a frame has `action.policy` (NaN if
    there is none), `intervention`, and `next.success`, which is true in the last frame of a successful episode.

    Errors: UsageError (nothing to write, or a rate that is not a whole number), BadRequest (an episode whose rate or features differ from
    the first).
    """
    data: Optional[LeRobotDataset] = None
    n_frame = n_episode = 0
    first = episodes[0].header
    fps = round(first.rate_hz)
    if fps != first.rate_hz:
        raise UsageError("--lerobot", "a whole number of control periods a second, as LeRobot counts", f"{first.rate_hz:g}")
    try:
        for episode in episodes:
            if _shape_of(episode.header) != _shape_of(first):
                raise BadRequest(str(episode.folder), f"rate, views, states and actions of {episodes[0].folder}", str(_shape_of(episode.header)))
            frames, following = tee(episode)
            next(following, None)
            for frame, after in zip_longest(frames, following):  # `after` is None at the end
                if not _is_kept(frame, only_human):
                    continue
                if data is None:
                    data = LeRobotDataset.create(folder.name, fps, _features_of(first), root=folder, use_videos=False)
                is_success = bool(episode.header.success) and after is None
                data.add_frame({**_frame_of(episode, frame), "next.success": np.array([is_success]), "task": episode.header.text})
                n_frame += 1
                if after is None or not _is_kept(after, only_human):
                    data.save_episode()
                    n_episode += 1
    finally:
        if data is not None:
            data.finalize()
    if data is None:
        raise UsageError("--lerobot", "commands of a person" if only_human else "commands")
    return {"frames": n_frame, "episodes": n_episode}


def _shape_of(header: Header) -> Tuple[Any, ...]:
    return header.rate_hz, dict(header.images), dict(header.states), header.action_names


def _is_kept(frame: np.void, only_human: bool) -> bool:
    return not np.isnan(frame["action"]).any() and (bool(frame["human"]) or not only_human)


def _features_of(header: Header) -> Dict[str, Any]:
    names, flag = list(header.action_names), {"dtype": "bool", "shape": (1,), "names": None}
    action = {"dtype": "float32", "shape": (len(names),), "names": names}
    found = {name: {"dtype": "image", "shape": (*size, 3), "names": ["height", "width", "channels"]} for name, size in header.images.items()}
    found.update({name: {"dtype": "float32", "shape": (len(n),), "names": list(n)} for name, n in header.states.items()})
    return {**found, "action": action, "action.policy": action, "intervention": flag, "next.success": flag}


def _frame_of(episode: Episode, frame: np.void) -> Dict[str, Any]:
    header = episode.header
    return {
        **{name: frame[f"image {name}"] for name in header.images},
        **{name: frame[f"state {name}"] for name in header.states},
        "action": frame["action"],
        "action.policy": frame["policy"],
        "intervention": np.array([frame["human"]]),
    }


def _answered(acts: Iterable[RecordedAct]) -> Iterator[RecordedAct]:
    return (act for act in acts if not isinstance(act.answer, VlaError))


def _starts(acts: Iterable[RecordedAct], fps: int, gap_s: float) -> List[bool]:
    """Whether each act starts an episode: the instruction has changed, or more than `gap_s` seconds have passed. Also checks `fps` against
    the recorded rate before anything is written: LeRobot counts time in frames, so a wrong rate would teach a wrong speed."""
    seen = [(act.text, act.record.received_ns / 1e9) for act in _answered(acts)]
    if not seen:
        raise UsageError("--lerobot", "acts that were answered with a chunk")
    starts, intervals = [True], []
    for (text, at), (next_text, next_at) in zip(seen, seen[1:]):
        starts.append(text != next_text or next_at - at > gap_s)
        if not starts[-1]:
            intervals.append(next_at - at)
    frames = float(np.median(intervals)) * fps if intervals else 1.0
    if abs(frames - 1) > MAX_OFF:
        hint = "a frame is written for each act: record with a chunk asked for at every step"
        raise UsageError("--fps", f"the rate of the acts, {fps / frames:.3g} a second (median)", str(fps), hint)
    return starts


def _frame(act: RecordedAct) -> Dict[str, Any]:
    images = {name: pixels(image) for name, image in act.images.items()}
    return {**images, **act.states, "action": act.answer.actions[0], "action_chunk": act.answer.actions}


def _features(act: RecordedAct, frame: Dict[str, Any]) -> Dict[str, Any]:
    names = {state.name: column_names(state.names, state.width) for state in act.spec.states}
    names["action"] = column_names(act.answer.names, act.answer.actions.shape[1])
    found = {}
    for name, value in frame.items():
        if name in act.images:
            found[name] = {"dtype": "image", "shape": value.shape, "names": ["height", "width", "channels"]}
        else:
            found[name] = {"dtype": "float32", "shape": value.shape, "names": names.get(name)}
    return found


def _check(act: RecordedAct, frame: Dict[str, Any], features: Dict[str, Any]) -> None:
    shapes = {name: tuple(value.shape) for name, value in frame.items()}
    expected = {name: tuple(feature["shape"]) for name, feature in features.items()}
    if shapes != expected:
        raise BadRequest(f"record {act.record.index}", f"features as in the first frame: {expected}", str(shapes))

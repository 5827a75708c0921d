# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""LeRobot data sets, written by LeRobot itself: of a server's recording a frame for each chunk, with the chunk's first row as its action;
of a loop's episodes a frame for each control period, with what was commanded."""

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

MAX_OFF = 0.25  # of a frame's time that the median distance of the acts may differ from it


def write_lerobot(folder: Path, acts: Iterable[RecordedAct], fps: int, gap_s: float) -> Dict[str, int]:
    """Frames and episodes that were written. Errors: UsageError (nothing to write, another rate than the recorded one), BadRequest
    (a frame with other views or sizes than the first)."""
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
    """Frames and episodes that were written. Periods without a command are left out; with `only_human` each time that a person drove is
    an episode. Beside what the policies of LeRobot read, a frame has `action.policy` (NaN where it wanted nothing), `intervention`, and
    `next.success`, true in the last frame of an episode that somebody called a success.

    Errors: UsageError (nothing to write), BadRequest (an episode of another rate, or with other features than the first).
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
    """Whether an episode starts with each act: where the instruction is another, or the robot had paused. Gone through first, since
    LeRobot counts time in frames: a data set of a wrong rate teaches a wrong speed."""
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

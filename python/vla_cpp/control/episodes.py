# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Records observations and actions of a robot per control period, with a person's corrections. `vla-export --lerobot` makes a LeRobot
data set of them.

    with EpisodeWriter("episodes", policy.spec, rate_hz=20) as episodes:
        episodes.begin("open the drawer")
        while running:
            seen = observe()
            action = loop.step(seen, human=...)
            episodes.add(seen, action)
        episodes.end(success=True)

An episode is a folder: `episode.json` describes the frames, and `frames.bin` holds them one after the other, all of the same size. A
written frame stays readable if the program dies; an episode without an `end` has no success.
"""

from __future__ import annotations

import json
import math
import os
import queue
import re
import threading
from dataclasses import asdict, dataclass
from io import FileIO
from pathlib import Path
from typing import Any, Dict, Iterator, List, Mapping, Optional, Tuple, Union

import numpy as np

from ..errors import BadObservation, BadRequest, IoError, UsageError
from ..export.common import column_names, pixels
from ..observation import image_arg, place, states_of
from ..output import write_text
from ..spec import Spec
from ..strict_json import no_constant, unique_names
from .schedule import Action

FORMAT = "vla-episode 1"
HEADER, FRAMES = "episode.json", "frames.bin"
MAX_WAITING = 64  # frames on their way to the disk
MAX_HEADER = 1 << 20  # bytes
MAX_FRAME = 1 << 30  # bytes


@dataclass(frozen=True)
class Header:
    """The contents of episode.json. images: (height, width) by view; states: names of the numbers by feature."""

    text: str
    rate_hz: float
    bundle: str
    checksum: str
    action_names: Tuple[str, ...]
    images: Mapping[str, Tuple[int, int]]
    states: Mapping[str, Tuple[str, ...]]
    success: Optional[bool] = None

    def frame_type(self) -> np.dtype:
        """The layout of a frame. `action` and `policy` are NaN where there was none. Errors: ValueError beyond MAX_FRAME."""
        if sum(3 * height * width for height, width in self.images.values()) > MAX_FRAME:
            raise ValueError(f"images of more than {MAX_FRAME} bytes")
        fields: List[Any] = [("tick", "<i8"), ("human", "?"), ("held", "?")]
        n = len(self.action_names)
        fields += [("action", "<f4", (n,)), ("policy", "<f4", (n,))]
        fields += [(f"state {name}", "<f4", (len(names),)) for name, names in self.states.items()]
        fields += [(f"image {name}", "u1", (*size, 3)) for name, size in self.images.items()]
        return np.dtype(fields)


class Episode:
    """Reads an episode. Errors: IoError (no episode), BadRequest (damaged, with the place)."""

    def __init__(self, folder: Union[str, Path]) -> None:
        self.folder = Path(folder)
        self.header = _read_header(self.folder / HEADER)
        self._type = self.header.frame_type()
        try:
            size = (self.folder / FRAMES).stat().st_size
        except OSError as problem:
            raise IoError(str(self.folder / FRAMES), "frames of an episode", str(problem)) from None
        self.n_frame, rest = divmod(size, self._type.itemsize)
        self.is_cut = rest > 0  # the writer was killed while it wrote a frame; that frame is left out

    def __iter__(self) -> Iterator[np.void]:
        with open(self.folder / FRAMES, "rb") as file:
            for index in range(self.n_frame):
                data = file.read(self._type.itemsize)
                if len(data) != self._type.itemsize:
                    raise BadRequest(f"{self.folder / FRAMES}: frame {index}", f"{self._type.itemsize} bytes", str(len(data)))
                yield np.frombuffer(data, self._type)[0]


def episodes_of(folder: Union[str, Path]) -> List[Episode]:
    """All episodes of a folder, in order. Errors: those of Episode; UsageError if there is none."""
    found = sorted(path for path in Path(folder).glob("episode_*") if (path / HEADER).is_file())
    if not found:
        raise UsageError(str(folder), "episodes that EpisodeWriter wrote", "none")
    return [Episode(path) for path in found]


class EpisodeWriter:
    """Writes episodes into a folder. `add` copies its arguments and never waits for the disk. If the disk is too slow, `add` raises
    IoError, since silently dropped frames would teach a wrong speed.

    folder   new episodes are numbered after the existing ones
    rate_hz  control periods per second
    """

    def __init__(self, folder: Union[str, Path], spec: Spec, rate_hz: float) -> None:
        if not 0 < rate_hz < math.inf:
            raise UsageError("rate_hz", "control periods per second, above 0", str(rate_hz))
        self._folder, self._spec, self._rate_hz = Path(folder), spec, rate_hz
        self._header: Optional[Header] = None
        self._text: Optional[str] = None
        self._at: Optional[Path] = None
        self._queue: queue.Queue = queue.Queue(MAX_WAITING)
        self._problem: Optional[OSError] = None
        self._thread: Optional[threading.Thread] = None

    def begin(self, text: str) -> None:
        """Begins an episode. Errors: UsageError if the last one has not ended; IoError."""
        if self._text is not None:
            raise UsageError("begin", "the end of the episode before", "one that goes on")
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            numbers = [int(found[1]) for path in self._folder.iterdir() if (found := re.fullmatch(r"episode_(\d{6})", path.name))]
            self._at = self._folder / f"episode_{max(numbers, default=-1) + 1:06}"
            self._at.mkdir()
        except OSError as problem:
            raise IoError(str(self._folder), "a place to write", str(problem)) from None
        self._text, self._header, self._problem = text, None, None

    def add(self, observation: Mapping[str, Any], action: Action) -> None:
        """Adds a control period: the arguments of `policy.act`, and the result of `loop.step`.

        Errors: UsageError before `begin`; BadObservation for views, sizes or states that differ from the episode's first frame; IoError.
        """
        if self._text is None or self._at is None:
            raise UsageError("add", "begin first", "no episode")
        images = {
            place("view", name, self._spec.views): pixels(image_arg(name, image))
            for name, image in observation.get("images", {}).items()
            if image is not None
        }
        states = states_of(observation["state"], self._spec.states)
        if self._header is None:
            self._open(images, states)
        header = self._header
        found = {name: image.shape[:2] for name, image in images.items()}
        if found != dict(header.images) or {name: len(v) for name, v in states.items()} != {name: len(n) for name, n in header.states.items()}:
            raise BadObservation("observation", f"views and states as in the first frame: {dict(header.images)}", str(found))
        frame = np.zeros((), header.frame_type())
        frame["tick"], frame["human"], frame["held"] = action.tick, action.human, action.held
        frame["action"] = math.nan if action.values is None else action.values
        frame["policy"] = _policy_of(action)
        for name, values in states.items():
            frame[f"state {name}"] = values
        for name, image in images.items():
            frame[f"image {name}"] = image
        self._check()
        try:
            self._queue.put_nowait(frame.tobytes())
        except queue.Full:
            raise IoError(str(self._at), f"a disk that takes {frame.nbytes} bytes {self._rate_hz:g} times a second", "a slower one") from None

    def end(self, success: Optional[bool]) -> None:
        """Ends the episode. `success`: whether it succeeded, None if unknown. An episode without frames is removed. Errors: IoError."""
        if self._text is None or self._at is None:
            raise UsageError("end", "an episode", "none")
        self._stop()
        self._text = None
        if self._header is None:
            self._at.rmdir()
            return
        self._check()
        write_header(self._at, Header(**{**vars(self._header), "success": success}))

    def close(self) -> None:
        """Ends the current episode, if any, with an unknown success."""
        if self._text is not None:
            self.end(None)

    def __enter__(self) -> EpisodeWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # --- inside ----------------------------------------------------------------------------------------------------------------

    def _open(self, images: Mapping[str, np.ndarray], states: Mapping[str, np.ndarray]) -> None:
        names = {state.name: tuple(state.names) for state in self._spec.states}
        self._header = Header(
            text=self._text or "", rate_hz=self._rate_hz, bundle=self._spec.bundle.name, checksum=self._spec.bundle.checksum,
            action_names=tuple(column_names(self._spec.action_names, self._spec.d_action)),
            images={name: (int(image.shape[0]), int(image.shape[1])) for name, image in images.items()},
            states={name: tuple(column_names(names.get(name, ()), len(values))) for name, values in states.items()},
        )  # fmt: skip
        try:
            write_header(self._at, self._header)
            file = open(self._at / FRAMES, "xb", buffering=0)
        except OSError as problem:
            raise IoError(str(self._at), "a place to write", str(problem)) from None
        self._thread = threading.Thread(target=self._write, args=(file,), daemon=True)
        self._thread.start()

    def _write(self, file: FileIO) -> None:
        """Appends queued frames until `_stop`. After an error it truncates the partly written frame and discards further frames."""
        with file:
            while (data := self._queue.get()) is not None:
                try:
                    left = memoryview(data if self._problem is None else b"")
                    while left:
                        left = left[file.write(left) :]
                except OSError as problem:
                    self._problem = problem
                    file.truncate(file.tell() // len(data) * len(data))

    def _stop(self) -> None:
        if self._thread is not None:
            self._queue.put(None)
            self._thread.join()
            self._thread = None

    def _check(self) -> None:
        if self._problem is not None:
            raise IoError(str(self._at), "a disk that takes frames", str(self._problem))


def write_header(folder: Path, header: Header) -> None:
    document = {"format": FORMAT, **asdict(header)}
    write_text(folder / HEADER, json.dumps(document, indent=2) + "\n")


def _policy_of(action: Action) -> Any:
    if action.human:
        return math.nan if action.policy is None else action.policy
    return math.nan if action.values is None or action.held else action.values


def _read_header(path: Path) -> Header:
    try:
        if not path.is_file() or os.path.getsize(path) > MAX_HEADER:
            raise IoError(str(path), "the header of an episode", "no regular file of a header's size")
        document: Dict[str, Any] = json.loads(path.read_text("utf-8"), parse_constant=no_constant, object_pairs_hook=unique_names)
        if document.pop("format", None) != FORMAT:
            raise ValueError(f'a format that is not "{FORMAT}"')
        return _checked(Header(**document))
    except (OSError, ValueError, TypeError, AttributeError, RecursionError) as problem:
        raise BadRequest(str(path), "the header of an episode", str(problem)) from None


def _checked(header: Header) -> Header:
    texts = (header.text, header.bundle, header.checksum, *header.action_names, *header.images, *header.states)
    if not all(isinstance(text, str) for text in (*texts, *(n for names in header.states.values() for n in names))):
        raise ValueError("a name that is no text")
    if not (isinstance(header.rate_hz, (int, float)) and 0 < header.rate_hz < math.inf) or not header.action_names:
        raise ValueError("no rate, or no actions")
    sizes = [n for size in header.images.values() for n in size]
    if not all(isinstance(n, int) and 0 < n < 1 << 16 for n in sizes) or any(len(size) != 2 for size in header.images.values()):
        raise ValueError("images without a size")
    if header.success not in (None, True, False):
        raise ValueError("success that is neither true nor false")
    images = {name: (size[0], size[1]) for name, size in header.images.items()}
    states = {name: tuple(names) for name, names in header.states.items()}
    checked = Header(**{**vars(header), "action_names": tuple(header.action_names), "images": images, "states": states})
    checked.frame_type()
    return checked

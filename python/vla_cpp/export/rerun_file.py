# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Writes RRD files, for Rerun's viewer."""

from __future__ import annotations

from pathlib import Path
from typing import Iterable

import numpy as np
import rerun

from ..errors import VlaError
from ..recording import RecordedAct
from ..spec import Spec
from .common import column_names, picture_file


def write_rrd(path: Path, name: str, spec: Spec, acts: Iterable[RecordedAct]) -> None:
    """Writes acts to an RRD file. `name`: distinguishes recordings of one policy."""
    stream = rerun.RecordingStream("vla_cpp", recording_id=spec.bundle.checksum + name)
    stream.save(str(path))
    named = False
    for act in acts:
        if not named and not isinstance(act.answer, VlaError):
            _name_series(stream, act.spec)
            named = True
        _write_act(stream, act)
    stream.flush()
    stream.disconnect()


def _name_series(stream: rerun.RecordingStream, spec: Spec) -> None:
    for state in spec.states:
        names = column_names(state.names, state.width)
        stream.log(_path(state.name), rerun.SeriesLines(names=names), static=True)
    stream.log("action", rerun.SeriesLines(names=column_names(spec.action_names, spec.d_action)), static=True)


def _write_act(stream: rerun.RecordingStream, act: RecordedAct) -> None:
    _set_time(stream, act.record.received_ns)
    for view, image in act.images.items():
        kind, data = picture_file(image)
        stream.log(_path(view), rerun.EncodedImage(contents=data, media_type=f"image/{kind}"))
    for name, values in act.states.items():
        stream.log(_path(name), rerun.Scalars(values))
    stream.log("instruction", rerun.TextDocument(act.text))
    answer = act.answer
    if isinstance(answer, VlaError):
        stream.log("error", rerun.TextLog(f"{answer.code}: {answer}", level="ERROR"))
        return
    _set_time(stream, act.ready_ns)
    stream.log("action", rerun.Scalars(answer.actions[0]))
    stream.log("action/chunk", rerun.Tensor(answer.actions, dim_names=("row", "action")))
    for stage, ms in {"queue": answer.queue_ms, **answer.timing}.items():
        stream.log(f"timing_ms/{stage}", rerun.Scalars(ms))
    for note in answer.notes:
        stream.log("note", rerun.TextLog(note, level="WARN"))


def _set_time(stream: rerun.RecordingStream, at_ns: int) -> None:
    stream.set_time("time", timestamp=np.datetime64(at_ns, "ns"))


def _path(name: str) -> str:
    return name.replace(".", "/")

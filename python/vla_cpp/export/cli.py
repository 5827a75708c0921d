# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""vla-export: converts a recording of `vla serve --record`, or the episodes of a control loop, to formats of other programs."""

from __future__ import annotations

import argparse
import os
import shutil
import sys
from pathlib import Path
from typing import Any, Dict, Iterator, List, Optional

from ..errors import IoError, UsageError, VlaError
from ..installed import extra_hint
from ..output import is_special, whole_file

EPILOG = """examples:
  vla-export recording --mcap out.mcap
  vla-export recording --lerobot dataset --fps 10
  vla-export episodes --lerobot corrections --only-interventions
Exit codes: 0 done, 2 usage, 9 a file or a package, 11 a damaged recording."""
CODES = {"usage": 2, "io": 9, "bad_request": 11, "bad_observation": 11, "bad_action": 11}


def build_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser("vla-export", description=__doc__, epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path, help="folder of vla serve --record, or of vla_cpp.control.EpisodeWriter")
    parser.add_argument("--mcap", type=Path, metavar="FILE", help="for Foxglove, Lichtblick and what else reads MCAP")
    parser.add_argument("--rrd", type=Path, metavar="FILE", help="for Rerun's viewer")
    parser.add_argument("--lerobot", type=Path, metavar="DIR", help="a LeRobot data set. Of a recording: a frame for each chunk, its first row as the action. Of episodes: a frame for each control period, with what the policy wanted and whether a person drove")
    parser.add_argument("--only-interventions", action="store_true", help="of episodes: only what a person commanded")
    parser.add_argument("--fps", type=int, metavar="N", help="of a recording's LeRobot data set: how many acts a second were asked for")
    parser.add_argument("--gap", type=float, default=2.0, metavar="S", help="of the LeRobot data set: an episode ends where no act came for so many seconds, or the instruction changed (default 2)")
    parser.add_argument("--client", type=int, action="append", default=[], metavar="N", help="only acts of this connection, counted from 1 in the order of their first acts; may be given again. Required where there are several")
    parser.add_argument("--first", type=int, metavar="N", help="only so many records")
    return parser


class _Acts:
    """The acts to export; iterable once per format."""

    def __init__(self, a: argparse.Namespace) -> None:
        from ..recording import Recording

        self._recording, self._first = Recording(a.recording), a.first
        self.spec = self._recording.spec
        counts: Dict[int, int] = {}
        for act in self._all():
            counts[act.record.client] = counts.get(act.record.client, 0) + 1
        self.is_whole = self._recording.is_whole
        clients = list(counts)
        if len(clients) > 1 and not a.client:
            found = ", ".join(f"{i + 1} ({n} acts)" for i, n in enumerate(counts.values()))
            raise UsageError("--client", "connections of one robot", f"several: {found}")
        if not all(1 <= n <= len(clients) for n in a.client):
            raise UsageError("--client", f"1 to {len(clients)}", str(a.client))
        self._wanted = [clients[n - 1] for n in a.client] or clients

    def _all(self) -> Iterator[Any]:
        from ..recording import acts_of

        return acts_of(self._recording, self._first)

    def __iter__(self) -> Iterator[Any]:
        return (act for act in self._all() if act.record.client in self._wanted)


def export(a: argparse.Namespace) -> None:
    if not (a.mcap or a.rrd or a.lerobot):
        raise UsageError("vla-export", "--mcap, --rrd or --lerobot")
    if any(a.recording.glob("episode_*")):
        return export_episodes(a)
    if a.only_interventions:
        raise UsageError("--only-interventions", "episodes of a control loop", f"{a.recording}, which has none")
    if (a.lerobot is None) != (a.fps is None) or (a.fps is not None and a.fps < 1) or not a.gap > 0:
        raise UsageError("--lerobot", "--fps above 0 with it, and only with it", "", "--gap is above 0 too")
    _check_free(a.mcap, a.rrd, a.lerobot)
    acts = _Acts(a)
    if not acts.is_whole:
        print("vla-export: the recording has no end: its server was killed, or --first took a part", file=sys.stderr)
    if a.mcap:
        from .mcap_file import write_mcap

        _file(a.mcap, lambda part: write_mcap(part, acts.spec, acts))
    if a.rrd:
        from .rerun_file import write_rrd

        _file(a.rrd, lambda part: write_rrd(part, a.rrd.name, acts.spec, acts))
    if a.lerobot:
        from .lerobot_dataset import write_lerobot

        _tell(_folder(a.lerobot, lambda part: write_lerobot(part, acts, a.fps, a.gap)))


def export_episodes(a: argparse.Namespace) -> None:
    if not a.lerobot or a.mcap or a.rrd or a.fps or a.client or a.first:
        raise UsageError("vla-export", "--lerobot alone for episodes, whose rate they know", "another option")
    _check_free(a.lerobot)
    from ..control.episodes import episodes_of
    from .lerobot_dataset import write_episodes

    episodes = episodes_of(a.recording)
    for episode in episodes:
        if episode.is_cut:
            print(f"vla-export: {episode.folder} ends within a frame: its writer was killed", file=sys.stderr)
    _tell(_folder(a.lerobot, lambda part: write_episodes(part, episodes, a.only_interventions)))


def _check_free(*paths: Optional[Path]) -> None:
    for path in filter(None, paths):
        if path.exists() and not is_special(path):
            raise IoError(str(path), "a name that is free", "a file or folder")


def _tell(counts: Dict[str, int]) -> None:
    print(f"{counts['frames']} frames in {counts['episodes']} episodes")


def _file(path: Path, write: Any) -> None:
    try:
        with whole_file(path) as part:
            write(Path(part.name))
    except OSError as problem:
        raise IoError(str(path), "a place to write", str(problem)) from None


def _folder(path: Path, write: Any) -> Any:
    """Writes a folder beside `path` and renames it to `path` when it is complete."""
    part = path.with_name(path.name + ".part")
    _remove(part)  # left over from a killed export
    try:
        result = write(part)
        os.replace(part, path)
        return result
    except OSError as problem:
        raise IoError(str(path), "a place to write", str(problem)) from None
    finally:
        _remove(part)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    elif path.exists():
        path.unlink()


def main(argv: Optional[List[str]] = None) -> int:
    try:
        export(build_parser().parse_args(argv))
    except ModuleNotFoundError as error:
        package = str(error.name).partition(".")[0]
        hint = "pip install lerobot" if package == "lerobot" else extra_hint("rerun" if package == "rerun" else "export")
        print(f"vla-export: the module {package} is missing; {hint}", file=sys.stderr)
        return 9
    except VlaError as error:
        print(f"vla-export: {error.code}: {error}", file=sys.stderr)
        return CODES.get(error.code, 1)
    return 0


if __name__ == "__main__":
    sys.exit(main())

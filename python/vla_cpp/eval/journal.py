# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Episodes on disk, one JSON line each, so that a run can be killed at any time and goes on where it was."""

from __future__ import annotations

import json
import os
from dataclasses import asdict
from pathlib import Path
from typing import Any, Dict, List

from .episode import Outcome


class JournalMismatch(Exception):
    """The folder holds episodes of another run. Says what differs."""


class Journal:
    """`episodes.jsonl` in a folder: first what was run, then an episode a line.

    head  everything that the outcome of an episode depends on. Continuing with another head is refused, since the table would mix
          two experiments.
    """

    def __init__(self, folder: Path, head: Dict[str, Any]) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.path = folder / "episodes.jsonl"
        self.outcomes: List[Outcome] = []
        lines = self._whole_lines()
        if lines:
            self._check(json.loads(lines[0])["run"], json.loads(json.dumps(head)))
            self.outcomes = [Outcome(**json.loads(line)) for line in lines[1:]]
        self._file = self.path.open("a", encoding="utf-8")
        if not lines:
            self._write({"run": head})

    def add(self, outcome: Outcome) -> None:
        """On disk when this returns."""
        self.outcomes.append(outcome)
        self._write(asdict(outcome))

    def close(self) -> None:
        self._file.close()

    def _whole_lines(self) -> List[str]:
        """The lines that are complete. A last one without its end was cut off by a kill: it goes, and its episode runs again."""
        if not self.path.exists():
            return []
        data = self.path.read_bytes()
        whole = data[: data.rfind(b"\n") + 1]
        if len(whole) != len(data):
            os.truncate(str(self.path), len(whole))
        return whole.decode("utf-8").splitlines()

    def _check(self, found: Dict[str, Any], expected: Dict[str, Any]) -> None:
        differing = [key for key in sorted({*found, *expected}) if found.get(key) != expected.get(key)]
        if differing:
            told = "; ".join(f"{key}: there {found.get(key)!r}, now {expected.get(key)!r}" for key in differing)
            raise JournalMismatch(f"{self.path} holds another run ({told}): give another --out, or delete it")

    def _write(self, row: Dict[str, Any]) -> None:
        self._file.write(json.dumps(row, ensure_ascii=False) + "\n")
        self._file.flush()
        os.fsync(self._file.fileno())

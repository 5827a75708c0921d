# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The simulators that there are adapters for. Each is imported only when it is asked for."""

from __future__ import annotations

import importlib
from typing import Any, Type

from ..environment import Environment

_HOMES = {"metaworld": "MetaWorld", "libero": "Libero", "aloha": "Aloha", "null": "Null"}
NAMES = tuple(_HOMES)


class MissingSimulator(Exception):
    """A simulator, or something that it needs, is not on this machine. Says what and how to get it."""


def find(name: str) -> Type[Environment]:
    """The adapter's class. Errors: KeyError for a name that is not in NAMES."""
    return getattr(importlib.import_module(f".{name}", __name__), _HOMES[name])


def no_task(name: str, task: str) -> str:
    """What to say of a task that a simulator does not have."""
    kind = find(name)
    there = [f"{suite}/0 to {len(tasks) - 1}" for suite, tasks in kind.suites().items()] or kind.tasks()
    return f"{name} has no task '{task}'; there are: {', '.join(there)}"


def make(name: str, task: str, **options: Any) -> Environment:
    """A task of a simulator. Errors: MissingSimulator, ValueError for an unknown task."""
    kind = find(name)
    if task not in kind.tasks():
        raise ValueError(no_task(name, task))
    return kind(task, **options)

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The simulators that there are adapters for. Each is imported only when it is asked for."""

from __future__ import annotations

import importlib
from typing import Any, Type

from ..environment import Environment

_HOMES = {"metaworld": "MetaWorld", "libero": "Libero", "null": "Null"}
NAMES = tuple(_HOMES)


class MissingSimulator(Exception):
    """A simulator, or something that it needs, is not on this machine. Says what and how to get it."""


def find(name: str) -> Type[Environment]:
    """The adapter's class. Errors: KeyError for a name that is not in NAMES."""
    return getattr(importlib.import_module(f".{name}", __name__), _HOMES[name])


def make(name: str, task: str, **options: Any) -> Environment:
    """A task of a simulator. Errors: MissingSimulator, ValueError for an unknown task."""
    kind = find(name)
    if task not in kind.tasks():
        raise ValueError(f"{name} has no task '{task}'; there are: {', '.join(kind.tasks())}")
    return kind(task, **options)

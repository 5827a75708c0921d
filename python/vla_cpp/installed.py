# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Whether this package is in a source tree or installed, and how to install missing packages in either case."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path
from typing import Optional

PACKAGE = Path(__file__).resolve().parent


def source_tree() -> Optional[Path]:
    """The root of vla.cpp; None for a package that is installed without the source tree."""
    root = PACKAGE.parents[1]
    return root if (root / "src/capi").is_dir() else None


def extra_hint(extra: str) -> str:
    """How to install the packages of an extra."""
    if source_tree():
        return f"at the root of vla.cpp: pip install './python[{extra}]'"
    try:
        stated = requires("vla-cpp") or []
    except PackageNotFoundError:
        stated = []
    marks = [f'extra == "{extra}"', f"extra == '{extra}'"]
    needs = [f"'{need.partition(';')[0].strip()}'" for need in stated if any(mark in need for mark in marks)]
    return "pip install " + " ".join(needs or [f"'vla-cpp[{extra}]'"])

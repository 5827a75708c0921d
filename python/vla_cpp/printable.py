# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Makes text from a file or a peer safe for a terminal and a log."""

from __future__ import annotations

MAX_LENGTH = 4000  # characters of one text


def printable(text: str) -> str:
    """The text in one line: control characters, line ends and marks of writing direction are replaced by visible escapes."""
    shown = text if len(text) <= MAX_LENGTH else text[:MAX_LENGTH] + "..."
    return shown if shown.isprintable() else "".join(c if c.isprintable() else _escaped(c) for c in shown)


def _escaped(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Text that comes from a file or a peer, made fit for a terminal and a log."""

from __future__ import annotations

MAX_LENGTH = 4000  # characters of one text


def printable(text: str) -> str:
    """One line: escape sequences, line ends and marks that turn the direction of writing are shown as escapes, never sent."""
    shown = text if len(text) <= MAX_LENGTH else text[:MAX_LENGTH] + "..."
    return shown if shown.isprintable() else "".join(c if c.isprintable() else _escaped(c) for c in shown)


def _escaped(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")

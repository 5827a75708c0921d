# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What `Client` and `Policy` have in common beside `act`."""

from __future__ import annotations

from typing import TypeVar

from .errors import UsageError

Self = TypeVar("Self", bound="Handle")


class Handle:
    """Is closed by its `with` block, and belongs to the process that made it."""

    def close(self) -> None:
        raise NotImplementedError

    def __enter__(self: Self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __reduce__(self):
        raise wrong_process(self, "an attempt to pickle it")


def wrong_process(handle: Handle, found: str) -> UsageError:
    return UsageError(type(handle).__name__, "use in the process that made it", found, "make one per process")

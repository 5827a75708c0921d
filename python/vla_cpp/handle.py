# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The common part of `Client` and `Policy`, except `act`."""

from __future__ import annotations

from functools import partial
from typing import Any, Optional, TypeVar

from .errors import UsageError
from .observation import robot_of

Self = TypeVar("Self", bound="Handle")


class Handle:
    """A context manager that closes itself. Only the process that made it may use it."""

    def close(self) -> None:
        raise NotImplementedError

    def robot(self, embodiment: Optional[str]) -> Robot:
        """One robot of a policy with several, as a policy of its own, e.g. for a ChunkLoop. `embodiment` is None if the policy has one
        robot. Errors: BadObservation, which lists the tags."""
        return Robot(self, embodiment)

    def __enter__(self: Self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __reduce__(self):
        raise wrong_process(self, "an attempt to pickle it")


class Robot:
    """`spec`, `act` and, for a Client, `submit`, bound to one robot."""

    def __init__(self, policy: Any, embodiment: Optional[str]) -> None:
        self.spec = robot_of(policy.spec, embodiment)
        self.act = partial(policy.act, embodiment=embodiment)
        if hasattr(policy, "submit"):
            self.submit = partial(policy.submit, embodiment=embodiment)


def wrong_process(handle: Handle, found: str) -> UsageError:
    return UsageError(type(handle).__name__, "use in the process that made it", found, "make one per process")

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Results of a client: pending answers, and the state of the server."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Optional

from .answer import Asked
from .errors import VlaError

if TYPE_CHECKING:
    from .client import Client


@dataclass(frozen=True)
class Health:
    """The server's state. uptime_s: seconds since it became ready. queue_depth: waiting acts, without the one that is computed."""

    ready: bool
    queue_depth: int
    computing: bool
    uptime_s: float
    chunks_served: int
    errors_served: int


class Pending:
    """A pending answer."""

    def __init__(
        self, client: Client, request_id: int, kind: str, timeout: float, asked: Optional[Asked], begun: Optional[float]
    ) -> None:
        self._client, self._id, self._kind, self._asked = client, request_id, kind, asked
        self._timeout, self._until = timeout, (time.monotonic() if begun is None else begun) + timeout
        self._answer: Any = None
        self._error: Optional[VlaError] = None

    def done(self) -> bool:
        """Whether `result` would return or raise immediately. Never waits."""
        return self._client._settle(self, 0.0)

    def result(self) -> Any:
        """Waits for the answer, up to the request's timeout. Errors: those of `Client.act`."""
        while not self._client._settle(self, self._until - time.monotonic()):
            pass
        if self._error:
            raise self._error
        return self._answer

    @property
    def _is_over(self) -> bool:
        return self._answer is not None or self._error is not None

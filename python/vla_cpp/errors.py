# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""All errors of a policy: one exception class per error code.

The codes and the four texts are those of the runtime (`src/base/result.h`); server and client add codes of their own.
"""

from __future__ import annotations


class VlaError(Exception):
    """An error, readable for a person (`str(error)`) and for a program.

    code      the error class, e.g. "bad_observation"
    where     file, feature or address
    expected  may be empty when `found` says it all
    found     what was found instead; "nothing" for an empty text
    hint      what to do next, if known
    """

    code = "internal"

    def __init__(self, where: str, expected: str = "", found: str = "", hint: str = "", code: str = "") -> None:
        found = found or ("nothing" if expected else "")
        super().__init__(where, expected, found, hint)
        self.where, self.expected, self.found, self.hint = where, expected, found, hint
        if code:
            self.code = code

    def __str__(self) -> str:
        text = f"{self.where}: "
        text += f"expected {self.expected}, found {self.found}" if self.expected else self.found
        return f"{text}; {self.hint}" if self.hint else text

    def __reduce__(self):
        return type(self), (self.where, self.expected, self.found, self.hint, self.code)


class InternalError(VlaError):
    """A fault of the runtime; please report it."""

    code = "internal"


class UsageError(VlaError):
    """Wrong arguments."""

    code = "usage"


class BadBundle(VlaError):
    """The bundle is damaged, incomplete or of another version."""

    code = "bad_bundle"


class BadObservation(VlaError):
    """A frame, state, instruction or noise that the policy does not accept."""

    code = "bad_observation"


class BadAction(VlaError):
    """The policy computed an invalid action, such as a number that is not finite, so there is no chunk."""

    code = "bad_action"


class Unsupported(VlaError):
    """Valid, but not supported by this build."""

    code = "unsupported"


class OutOfMemory(VlaError):
    code = "out_of_memory"


class DeviceError(VlaError):
    """The compute device failed."""

    code = "device"


class IoError(VlaError):
    """A file or an address that cannot be used."""

    code = "io"


class Superseded(VlaError):
    """Server: a newer observation of the same client replaced this one in the queue."""

    code = "superseded"


class Late(VlaError):
    """Server: the request's deadline passed while it waited, or between two tokens of its answer; the answer was not completed."""

    code = "late"


class Busy(VlaError):
    """Server: the queue is full."""

    code = "busy"


class TooLarge(VlaError):
    """Server: the message, an image or the text is larger than the server admits."""

    code = "too_large"


class BadRequest(VlaError):
    """Server: the bytes are not a request of its schema; a fault of the client."""

    code = "bad_request"


class Incompatible(VlaError):
    """Server and client have no common protocol version, or an answer does not match its request or the policy."""

    code = "incompatible"


class ShuttingDown(VlaError):
    """Server: it is stopping and accepts no new requests."""

    code = "shutting_down"


class Timeout(VlaError):
    """Client: no answer within the time given."""

    code = "timeout"


class Disconnected(VlaError):
    """Client: the connection was lost, or the client is closed."""

    code = "disconnected"


class Noted(VlaError):
    """Loop: a chunk came with a note, and on_note is "raise"."""

    code = "noted"


_CLASSES = {
    c.code: c
    for c in (
        InternalError, UsageError, BadBundle, BadObservation, BadAction, Unsupported, OutOfMemory, DeviceError, IoError,
        Superseded, Late, Busy, TooLarge, BadRequest, Incompatible, ShuttingDown, Timeout, Disconnected, Noted,
    )
}  # fmt: skip


def error_of(code: str, where: str, expected: str = "", found: str = "", hint: str = "") -> VlaError:
    """The exception for a code; an unknown code becomes a plain VlaError with that code."""
    return _CLASSES.get(code, VlaError)(where, expected, found, hint, code)

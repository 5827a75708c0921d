# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Python side of vla.cpp.

    Client         a policy at `vla serve`
    OpenpiClient   a policy at a server that speaks openpi's protocol
    Policy         a policy in this process
    control        executing action chunks on a robot
    convert        converting checkpoints into bundles (the extra `convert`)

Names are imported on first use, so that each part needs only its own packages.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, List

__version__ = "0.1.0"

if TYPE_CHECKING:
    from . import control as control
    from .chunk import Chunk as Chunk
    from .client import Client as Client
    from .errors import *  # noqa: F403
    from .history import History as History
    from .observation import Leftover as Leftover
    from .openpi import OpenpiClient as OpenpiClient
    from .policy import Policy as Policy
    from .spec import BundleInfo as BundleInfo
    from .spec import Spec as Spec
    from .spec import StateSpec as StateSpec
    from .spec import ViewSpec as ViewSpec

_ERRORS = (
    "VlaError InternalError UsageError BadBundle BadObservation BadAction Unsupported OutOfMemory DeviceError IoError "
    "Superseded Late Busy TooLarge BadRequest Incompatible ShuttingDown Timeout Disconnected Noted"
).split()
_HOMES = {
    "Client": "client",
    "Policy": "policy",
    "Chunk": "chunk",
    "History": "history",
    "Leftover": "observation",
    "OpenpiClient": "openpi",
    **dict.fromkeys(("BundleInfo", "Spec", "StateSpec", "ViewSpec"), "spec"),
    **dict.fromkeys(_ERRORS, "errors"),
}
__all__ = ["control", *_HOMES]


def __getattr__(name: str):
    if name == "control":
        return importlib.import_module(".control", __name__)
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f".{_HOMES[name]}", __name__), name)


def __dir__() -> List[str]:
    return sorted({*globals(), *__all__})

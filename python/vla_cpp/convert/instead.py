# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What a source that is no policy was probably meant to be, and what to give instead."""

from __future__ import annotations

import glob
import os
import re

from .errors import Code, refuse
from .hub import HUB_NAME

POLICY = "pretrained_model"  # where LeRobot's training saves a policy
# Below the folder of a checkpoint, of a run, and of runs by name or by date and time.
BELOW = ("", "last", "*", "checkpoints/last", "checkpoints/*", "*/checkpoints/last", "*/*/checkpoints/last")


def instead_of(source: str) -> str:
    """The hint for a source that is no folder."""
    if source.endswith(".gguf"):
        return "a bundle is converted already: vla run takes it"
    if os.path.isfile(source):
        return "give the folder that holds the file"
    return "hub:{}@main fetches it from the hub".format(source) if re.fullmatch(HUB_NAME, source) else ""


def check_is_policy(folder: str) -> None:
    """Refuses a folder that has policies only further down. Errors: io."""
    names = [name for name in ("model.safetensors", "model.safetensors.index.json", "assets", "params", "adapter_config.json") if _has(folder, name)]
    if _has(folder, "config.json") or names:
        return
    policies = _policies_below(folder)
    if policies:
        found = "a folder of LeRobot's training" + (" with several runs" if len(policies) > 1 else "")
        raise refuse(folder, "a policy", found, "give " + " or ".join(policies[:3]), Code.IO)


def _has(folder: str, name: str) -> bool:
    return os.path.exists(os.path.join(folder, name))


def _policies_below(folder: str) -> list:
    """The nearest ones; of numbered checkpoints the last."""
    for below in BELOW:
        pattern = os.path.join(glob.escape(folder), *below.split("/"), POLICY, "config.json")
        found = sorted(os.path.dirname(file) for file in glob.glob(pattern))
        if found:
            return found[-1:] if below in ("*", "checkpoints/*") else found
    return []

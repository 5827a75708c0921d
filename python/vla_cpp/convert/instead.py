# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Hints for a source that is not a policy: what the user probably meant, and what to give instead."""

from __future__ import annotations

import glob
import os
import re

from .errors import Code, refuse
from .hub import HUB_NAME

POLICY = "pretrained_model"  # where LeRobot's training saves a policy
# Parent folders of POLICY below a given folder, which may be a checkpoint, a run, or a folder of runs by name or by date and time.
BELOW = ("", "last", "*", "checkpoints/last", "checkpoints/*", "*/checkpoints/last", "*/*/checkpoints/last")


def instead_of(source: str) -> str:
    """The hint for a source that is not a folder."""
    if source.endswith(".gguf"):
        return "a bundle is converted already: vla run takes it"
    if os.path.isfile(source):
        return "give the folder that holds the file"
    return "hub:{}@main fetches it from the hub".format(source) if re.fullmatch(HUB_NAME, source) else ""


def check_is_policy(folder: str) -> None:
    """Refuses a folder whose policies are only in subfolders. Errors: io."""
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
    """The policies at the nearest level below a folder; among numbered checkpoints only the last."""
    for below in BELOW:
        pattern = os.path.join(glob.escape(folder), *below.split("/"), POLICY, "config.json")
        found = sorted(os.path.dirname(file) for file in glob.glob(pattern))
        if found:
            return found[-1:] if below in ("*", "checkpoints/*") else found
    return []

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""π0: PaliGemma prefix, joint-attention action expert, the state as a token of its own.

Reference: lerobot src/lerobot/policies/pi0 and openpi src/openpi/models_pytorch; what π0.5 has too stands in _pi.py.
"""

from __future__ import annotations

from ..checkpoint import Checkpoint
from ..errors import Problems
from . import Options, Plan
from ._openpi import variants_of
from ._pi import make_plan
from ._pi_source import Family

FAMILY = Family(
    arch="pi0",
    config_class="PI0Config",
    max_tokens=48,
    time_mlp="action_time_mlp",
    other_time_mlp="time_mlp",
)
VARIANTS = variants_of("pi0")


def plan(checkpoint: Checkpoint, options: Options, problems: Problems) -> Plan:
    return make_plan(FAMILY, checkpoint, options, problems)

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""π0.5: like π0, but the discretized state is part of the prompt, and the time enters the expert through its norms.

Reference: lerobot src/lerobot/policies/pi05 and openpi src/openpi/models_pytorch. pi0/ has the common part with π0.
"""

from __future__ import annotations

from functools import partial

from .pi0 import make_plan
from .pi0.layouts import variants_of
from .pi0.mapping import Family

FAMILY = Family(arch="pi05", config_class="PI05Config", max_tokens=200, time_mlp="time_mlp", other_time_mlp="action_time_mlp")
VARIANTS = variants_of("pi05")
plan = partial(make_plan, FAMILY)

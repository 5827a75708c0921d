# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""How scripts/serve_attacked.py attacks a server, and who behaves there meanwhile. An attack takes where the server is,
and goes on until its process is ended."""

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "python"), str(ROOT / "tests/client")]

from . import doors, lerobot, local, native  # noqa: E402

# By what is attacked; "process" is the process of --lerobot.
ATTACKS_OF = {
    "native": (
        native.half_sent, native.flood, native.connections, native.drip, native.hostile_png, native.heavy_images, native.own_address,
        native.many_addresses,
    ),
    "page": (native.small_refusals, native.large_refusals, local.page_http),
    "metrics": (local.drip_http, local.many_http),
    "openpi": (doors.openpi,),
    "gr00t": (doors.gr00t,),
    "lerobot": (
        lerobot.calls, lerobot.rapid_reset, lerobot.continuations, lerobot.pings, lerobot.settings, lerobot.empty_data,
        lerobot.window_updates, lerobot.priorities, lerobot.table_bombs, lerobot.short_connections, lerobot.many_values, lerobot.odd_arrays,
        lerobot.crosswise,
    ),
    "process": (lerobot.door_killed, lerobot.door_stopped, lerobot.door_without_memory),
    "control": (local.orders,),
}  # fmt: skip
ATTACKS = {attack.__name__: attack for attacks in ATTACKS_OF.values() for attack in attacks}
DOOR_OF = {attack.__name__: door for door, attacks in ATTACKS_OF.items() for attack in attacks}

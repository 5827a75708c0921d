# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""How scripts/serve_attacked.py attacks a server, and who behaves there meanwhile. An attack takes where the server is,
and goes on until its process is ended."""

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "python"), str(ROOT / "tests/client")]

from .doors import gr00t, lerobot, openpi  # noqa: E402
from .native import (  # noqa: E402
    connections,
    drip,
    drip_http,
    flood,
    half_sent,
    heavy_images,
    hostile_png,
    many_addresses,
    own_address,
)

NATIVE = (half_sent, flood, connections, drip, drip_http, hostile_png, heavy_images, own_address, many_addresses)
ATTACKS = {attack.__name__: attack for attack in (*NATIVE, gr00t, openpi, lerobot)}

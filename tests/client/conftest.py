# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(Path(__file__).parent), str(ROOT / "python"), str(ROOT / "tests/cli")]

from faulty_server import FaultyServer  # noqa: E402


@pytest.fixture
def faulty():
    server = FaultyServer()
    yield server
    server.stop()

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(Path(__file__).parent), str(ROOT / "python"), str(ROOT / "tests/cli")]

from faulty_server import FaultyServer  # noqa: E402
from golden_cases import Golden  # noqa: E402
from server_process import SECONDS, Robot, Server  # noqa: E402

import vla_cpp  # noqa: E402


def pytest_configure(config):
    config.addinivalue_line("markers", "alone: attackers and their victim, and what times acts, need the machine (tests/CMakeLists.txt)")


@pytest.fixture
def faulty():
    server = FaultyServer()
    yield server
    server.stop()


@pytest.fixture(scope="module")
def case():
    return Golden("two_views")


@pytest.fixture(scope="module")
def server(case):
    """`vla serve` of the case, for all tests of a file."""
    server = Server(case)
    yield server
    assert server.stop() == 0


@pytest.fixture
def robot(server, case):
    with Robot(server.address, case) as robot:
        yield robot


@pytest.fixture(params=["server", "process"])
def where(request, case, server):
    """What an example takes, and `vla_cpp` makes a policy of."""
    return server.address if request.param == "server" else str(case.bundle)


@pytest.fixture
def policy(where):
    with vla_cpp.Client(where, timeout=SECONDS) if "://" in where else vla_cpp.Policy(where, threads=1) as policy:
        yield policy

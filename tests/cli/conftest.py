# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
import os
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(Path(__file__).parent), str(ROOT / "python")]

from golden_cases import Golden  # noqa: E402
from program import Program  # noqa: E402


@pytest.fixture(scope="session")
def vla():
    path = Path(os.environ.get("VLA_BINARY", ROOT / "build/cpu/bin/vla"))
    if not path.is_file():
        pytest.fail(f"{path} is not built: run `make build`, or set VLA_BINARY")
    return Program(path)


@pytest.fixture
def golden():
    return Golden("two_views")

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
import os
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "python")]


@pytest.fixture(scope="session")
def bundle():
    return ROOT / "models/metaworld-tiny.gguf"


@pytest.fixture(scope="session")
def binary():
    path = Path(os.environ.get("VLA_BINARY", ROOT / "build/cpu/bin/vla"))
    if not path.is_file():
        pytest.fail(f"{path} is not built: run `make build`, or set VLA_BINARY")
    return path

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
import os
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(Path(__file__).parent), str(ROOT / "tests/cli"), str(ROOT / "python")]

from commands import run  # noqa: E402
from golden_cases import Golden  # noqa: E402
from program import Program  # noqa: E402


@pytest.fixture(scope="session")
def build():
    """The build folder, which holds the program and the library."""
    library = Path(os.environ.get("VLA_LIBRARY", ROOT / "build/cpu/lib/libvla.so.1"))
    if not library.is_file():
        pytest.fail(f"{library} is not built: run `make build`, or set VLA_LIBRARY")
    return library.resolve().parents[1]


@pytest.fixture(scope="session")
def vla(build):
    return Program(build / "bin/vla")


@pytest.fixture(scope="session")
def prefix(build, tmp_path_factory):
    """Where `cmake --install` has put everything."""
    folder = tmp_path_factory.mktemp("prefix")
    run("cmake", "--install", build, "--prefix", folder)
    return folder


@pytest.fixture
def golden():
    return Golden("two_views")


@pytest.fixture
def chunk_of_run(vla, tmp_path):
    """The float32 array that `vla run --out` writes for a case and a seed, or for the noise of the case."""

    def chunk(case, seed=None):
        arguments = case.arguments(options=["--out", tmp_path / "chunk.npy"])
        if seed is not None:
            at = arguments.index("--noise")
            arguments[at : at + 2] = ["--seed", seed]
        assert vla(*arguments).code == 0
        return np.load(tmp_path / "chunk.npy")

    return chunk


@pytest.fixture(scope="session")
def example_arguments():
    """The command line of examples/c/act.c and examples/cpp/act.cpp for a golden case."""

    def arguments(case, seed):
        state = ",".join(map(repr, case.state))
        return [case.bundle, case.text, state, seed, *(f"{view}={file or ''}" for view, file in case.images.items())]

    return arguments

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""`vla` and libvla.so beside the libvla-cuda.so of fake_library.cpp, whose driver fails when told to. No GPU is needed."""

import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "tests/cli"), str(ROOT / "python")]

from golden_cases import Golden  # noqa: E402
from program import Program  # noqa: E402

DEVICE = ["--device", "cuda"]


class Fake:
    """A folder with the program, the library for other programs, and the driver."""

    def __init__(self, folder):
        self.counts = folder / "counts"
        for variable, name in (("VLA_BINARY", "vla"), ("VLA_LIBRARY", "libvla.so.1"), ("VLA_FAKE_LIBRARY", "libvla-cuda.so")):
            shutil.copy(os.environ[variable], folder / name)
        self.library = folder / "libvla.so.1"
        self._path = folder / "vla"

    def program(self, **settings):
        self.counts.unlink(missing_ok=True)
        program = Program(self._path)
        program.environment.update({f"VLA_FAKE_{name.upper()}": str(value) for name, value in settings.items()})
        return program

    def calls(self, *arguments):
        """What the driver is asked for, one word a call."""
        answer = self.program(counts=self.counts)(*arguments)
        assert answer.code == 0, answer.err
        return self.counts.read_text(encoding="utf-8").split()


@pytest.fixture(scope="session")
def fake(tmp_path_factory):
    return Fake(tmp_path_factory.mktemp("fake"))


@pytest.fixture
def golden():
    return Golden("two_views")


@pytest.fixture
def serve(fake, golden):
    servers = []

    def start(*options, **settings):
        program = fake.program(**settings)
        command = [program.path, "serve", golden.bundle, "--bind", "tcp://127.0.0.1:0", *DEVICE, *options]
        pipe = subprocess.PIPE
        servers.append(subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, env=program.environment))
        return servers[-1]

    yield start
    for server in servers:
        server.kill()
        server.communicate()


def address(server):
    word, *fields = shlex.split(server.stdout.readline())
    assert word == "ready"
    return dict(field.split("=", 1) for field in fields)["address"]

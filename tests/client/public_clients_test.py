# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The public clients as they come, on recorded frames: each chunk that one gets is that of `vla run`, bit for bit.

A client that this Python has is run; one of another Python, or from a folder of sources, where VLA_PUBLIC_CLIENTS names it as
tools/public_clients does: "gr00t-n1.7=/venv/bin/python:/src/gr00t lerobot=/other/bin/python".
"""

import importlib.util
import os
import subprocess
import sys

import pytest

pytest.importorskip("msgpack")

from server_process import ROOT, VLA  # noqa: E402

MODULES = {"openpi": "openpi_client", "openpi-broker": "openpi_client", "lerobot": "lerobot"}
MODULES.update({f"gr00t-n1.{n}": "gr00t" for n in (5, 6, 7)})
GIVEN = dict(client.split("=", 1) for client in os.environ.get("VLA_PUBLIC_CLIENTS", "").split())


def tool(*arguments):
    command = [sys.executable, ROOT / "tools/public_clients", "--vla", VLA, "--recorded", *arguments]
    return subprocess.run(list(map(str, command)), capture_output=True, text=True, timeout=300)


@pytest.mark.parametrize("client", sorted(MODULES.keys() | GIVEN.keys()))
def test_a_public_client_as_it_comes_gets_the_chunks_of_vla_run(client):
    python = GIVEN.get(client) or (importlib.util.find_spec(MODULES[client]) and sys.executable)
    if not python:
        pytest.skip(f"{client}: this Python has no {MODULES[client]}, and VLA_PUBLIC_CLIENTS names none that has")
    done = tool(f"{client}={python}")
    assert done.returncode == 0, done.stdout + done.stderr
    assert f"| {client} | recorded | 8 looks | 8 looks | " in done.stdout


STANDS_FOR_OPENPI = """
import sys
sys.path.append({tests!r})
from drop_in import WebSocket, openpi_array, pack

class WebsocketClientPolicy:
    def __init__(self, host, port):
        self._socket = WebSocket(f"{{host}}:{{port}}")
        self._socket.receive()

    def infer(self, observation):
        answer = self._socket.ask(pack(observation, openpi_array))
        return {{"actions": answer["actions"] + {error}}}
"""


@pytest.mark.parametrize("error, code", [("0", 0), ("0.001", 1)])
def test_the_tool_tells_a_client_that_gets_the_chunks_from_one_that_does_not(tmp_path, error, code):
    package = tmp_path / "openpi_client"
    package.mkdir()
    (package / "websocket_client_policy.py").write_text(
        STANDS_FOR_OPENPI.format(tests=str(ROOT / "tests/client"), error=error)
    )
    done = tool(f"openpi={sys.executable}:{tmp_path}")
    assert (done.returncode, "**differ**" in done.stdout) == (code, bool(code)), done.stdout + done.stderr

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""vla-pull, and the names that commands take from its cache, against a server that speaks the hub's routes."""

import hashlib
import json
import os
import re
import subprocess
import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest
from conftest import ROOT
from program import Program

DEMO = ROOT / "models/metaworld-tiny.gguf"
COMMIT = "0123456789abcdef0123456789abcdef01234567"
NAME = "hub:someone/policy@main"


class Hub(ThreadingHTTPServer):
    """someone/policy with a bundle in large-file storage, behind a redirect."""

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Handler)
        self.hold(DEMO.read_bytes())
        self.asked = []  # (method, path, range)
        self.cut_after = None  # bytes of the next answer that are sent before the connection ends
        self.refuses = False
        threading.Thread(target=self.serve_forever, daemon=True).start()

    def hold(self, data):
        self.data, self.digest = data, hashlib.sha256(data).hexdigest()

    def run(self, *arguments, home, **environment):
        environment = {**os.environ, "HF_ENDPOINT": f"http://127.0.0.1:{self.server_port}", "HF_HOME": str(home),
                       "HF_HUB_DISABLE_XET": "1", "HF_HUB_DISABLE_TELEMETRY": "1", **environment}  # fmt: skip
        environment.pop("HF_HUB_CACHE", None)
        command = [sys.executable, "-m", "vla_cpp.pull", *arguments]
        return subprocess.run(command, capture_output=True, text=True, env=environment, timeout=120)


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def do_HEAD(self):
        self._answer()

    def do_GET(self):
        self._answer()

    def _answer(self):
        hub, path = self.server, self.path.split("?")[0]
        hub.asked.append((self.command, path, self.headers.get("Range")))
        if hub.refuses:
            self._send(401, b"{}", {"X-Error-Code": "GatedRepo", "X-Error-Message": "a token is needed"})
        elif re.fullmatch(r"/api/models/someone/policy(/revision/\w+)?", path):
            siblings = [{"rfilename": name} for name in ("policy.gguf", "README.md")]
            self._send(200, json.dumps({"id": "someone/policy", "sha": COMMIT, "siblings": siblings}).encode())
        elif path.startswith("/api/models/someone/policy/tree/"):
            lfs = {"oid": hub.digest, "size": len(hub.data), "pointerSize": 130}
            file = {"type": "file", "path": "policy.gguf", "size": len(hub.data), "oid": "0" * 40, "lfs": lfs}
            self._send(200, json.dumps([file]).encode())
        elif path == f"/someone/policy/resolve/{COMMIT}/policy.gguf":
            linked = {"X-Repo-Commit": COMMIT, "X-Linked-Etag": f'"{hub.digest}"', "X-Linked-Size": str(len(hub.data))}
            linked["Location"] = f"http://localhost:{hub.server_port}/cdn/file"  # of another host, as the hub's storage is
            self._send(302, b"", linked)
        elif path == "/cdn/file":
            self._file()
        else:
            self._send(404, b"{}", {"X-Error-Code": "RepoNotFound"})

    def _file(self):
        data, status, headers = self.server.data, 200, {}
        if asked := re.fullmatch(r"bytes=(\d+)-", self.headers.get("Range", "")):
            status, headers = 206, {"Content-Range": f"bytes {asked[1]}-{len(data) - 1}/{len(data)}"}
            data = data[int(asked[1]) :]
        cut, self.server.cut_after = self.server.cut_after, None
        self._send(status, data, headers, cut)

    def _send(self, status, body, headers=None, cut=None):
        self.send_response(status)
        for name, value in {**(headers or {}), "Content-Length": str(len(body))}.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command == "GET":
            self.wfile.write(body[:cut])
        if cut is not None:
            self.close_connection = True

    def log_message(self, *_):
        pass


@pytest.fixture
def hub():
    pytest.importorskip("huggingface_hub")
    hub = Hub()
    yield hub
    hub.shutdown()
    hub.server_close()


@pytest.fixture
def vla_here(vla, tmp_path, monkeypatch):
    """The program, with the cache in tmp_path."""
    monkeypatch.delenv("HF_HUB_CACHE", raising=False)
    monkeypatch.setenv("HF_HOME", str(tmp_path))
    return Program(vla.path)


def test_a_bundle_is_pulled_listed_taken_by_name_and_removed(hub, vla_here, tmp_path):
    done = hub.run(NAME, home=tmp_path)
    assert done.returncode == 0, done.stderr
    file = done.stdout.strip()
    assert open(file, "rb").read() == hub.data and COMMIT in file
    assert not any("README" in path for _, path, _ in hub.asked if "resolve" in path)
    listed = hub.run("--list", home=tmp_path).stdout
    assert listed.startswith(f"{NAME}  9.2 MB  policy.gguf")
    for name in (NAME, f"hub:someone/policy@{COMMIT}"):
        answer = vla_here("inspect", name)
        assert answer.code == 0 and f"bundle       {file}" in answer.out, answer.err
    assert hub.run("--remove", NAME, home=tmp_path).stdout.startswith(f"removed {NAME}")
    assert hub.run("--list", home=tmp_path).stdout == ""
    answer = vla_here("inspect", NAME)
    assert answer.code == 2 and f"vla-pull {NAME}" in answer.err
    assert hub.run("--remove", NAME, home=tmp_path).returncode == 9


def test_what_was_cut_off_is_resumed_where_it_ended(hub, tmp_path):
    hub.hold(bytes(3) * 10_000_000)
    hub.cut_after = 15_000_000  # the library keeps 10 MiB at a time
    done = hub.run(NAME, home=tmp_path)
    assert done.returncode == 0, done.stderr
    ranges = [asked for method, path, asked in hub.asked if (method, path) == ("GET", "/cdn/file")]
    assert ranges[0] is None and len(ranges) == 2 and 0 < int(ranges[1][6:-1]) <= 15_000_000
    assert open(done.stdout.strip(), "rb").read() == hub.data


def test_other_bytes_than_the_hub_states_are_removed(hub, tmp_path):
    hub.data = hub.data[:-1] + bytes([hub.data[-1] ^ 1])
    done = hub.run(NAME, home=tmp_path)
    assert done.returncode == 9 and "expected bytes of SHA-256" in done.stderr
    assert hub.run("--list", home=tmp_path).stdout == "" and not list(tmp_path.rglob("*.gguf"))


def test_what_the_hub_refuses_is_told(hub, tmp_path):
    hub.refuses = True
    done = hub.run(NAME, home=tmp_path)
    assert done.returncode == 9 and "expected a reachable hub repository" in done.stderr
    assert "401" in done.stderr or "token" in done.stderr


def test_a_pulled_bundle_needs_no_hub(hub, tmp_path):
    assert hub.run(NAME, home=tmp_path).returncode == 0
    assert hub.run(NAME, home=tmp_path, HF_HUB_OFFLINE="1").returncode == 0


@pytest.mark.parametrize("name", ["hub:policy", "hub:a/b", "hub:../x@main", "hub:a/b@../../etc", "hub:a/b@"])
def test_other_forms_are_refused_without_asking_the_hub(hub, vla, tmp_path, name):
    assert hub.run(name, home=tmp_path).returncode == 2 and not hub.asked
    answer = vla("inspect", name)
    assert answer.code == 2 and "hub:OWNER/NAME@REVISION" in answer.err


def test_several_bundles_of_a_repository_are_told_apart_by_file(vla_here, tmp_path):
    snapshot = tmp_path / "hub/models--someone--policy/snapshots" / COMMIT
    snapshot.mkdir(parents=True)
    for name in ("a.gguf", "b.gguf"):
        (snapshot / name).symlink_to(DEMO)
    answer = vla_here("inspect", f"hub:someone/policy@{COMMIT}")
    assert answer.code == 2 and "2 bundles in" in answer.err

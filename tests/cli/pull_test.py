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
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest
from conftest import ROOT
from program import IS_SANITIZED, Program

DEMO = ROOT / "models/metaworld-tiny.gguf"
of_python = pytest.mark.skipif(IS_SANITIZED, reason="vla-pull is Python, which no sanitizer watches")
COMMIT = "0123456789abcdef0123456789abcdef01234567"
NAME = "hub:someone/policy@main"


class Hub(ThreadingHTTPServer):
    """someone/policy with a bundle in large-file storage, behind a redirect."""

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Handler)
        self.hold(DEMO.read_bytes())
        self.asked = []  # (method, path, range)
        self.cut_after = None  # bytes of the next answer that are sent before the connection ends
        self.stall_after = None  # bytes after which nothing more is sent
        self.listed = None  # bytes that the file has, as the hub says it; of itself the right number
        self.refuses = False
        self.commit, self.path, self.stated = COMMIT, "policy.gguf", None  # what the hub says; of the digest the right one
        self.stalled, self.goes_on = threading.Event(), threading.Event()
        threading.Thread(target=self.serve_forever, daemon=True).start()

    def hold(self, data):
        self.data, self.digest = data, hashlib.sha256(data).hexdigest()

    def command(self, *arguments, home, **environment):
        environment = {**os.environ, "HF_ENDPOINT": f"http://127.0.0.1:{self.server_port}", "HF_HOME": str(home),
                       "HF_HUB_DISABLE_XET": "1", "HF_HUB_DISABLE_TELEMETRY": "1", **environment}  # fmt: skip
        environment.pop("HF_HUB_CACHE", None)
        return {"args": [sys.executable, "-m", "vla_cpp.pull", *arguments], "env": environment, "text": True}

    def run(self, *arguments, **options):
        return subprocess.run(**self.command(*arguments, **options), capture_output=True, timeout=120)


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
            self._send(200, json.dumps({"id": "someone/policy", "sha": hub.commit, "siblings": siblings}).encode())
        elif path.startswith("/api/models/someone/policy/tree/"):
            size = hub.listed or len(hub.data)
            lfs = {"oid": hub.stated or hub.digest, "size": size, "pointerSize": 130}
            file = {"type": "file", "path": hub.path, "size": size, "oid": "0" * 40, "lfs": lfs}
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
        if self.server.stall_after is not None and self.command == "GET":
            self._send(status, data, headers, self.server.stall_after)
            self.wfile.flush()
            self.server.stalled.set()
            self.server.goes_on.wait(60)
            return
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
    hub.goes_on.set()
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


@of_python
def test_what_was_cut_off_is_resumed_where_it_ended(hub, tmp_path):
    hub.hold(bytes(3) * 10_000_000)
    hub.cut_after = 15_000_000  # the library keeps 10 MiB at a time
    done = hub.run(NAME, home=tmp_path)
    assert done.returncode == 0, done.stderr
    ranges = [asked for method, path, asked in hub.asked if (method, path) == ("GET", "/cdn/file")]
    assert ranges[0] is None and len(ranges) == 2 and 0 < int(ranges[1][6:-1]) <= 15_000_000
    assert open(done.stdout.strip(), "rb").read() == hub.data


def parts(home):
    """Files of the cache that are not whole."""
    return [path for path in home.rglob("*") if path.name.endswith((".part", ".incomplete"))]


@of_python
def test_a_pull_that_was_killed_is_continued_where_it_was_and_leaves_nothing_behind(hub, tmp_path):
    hub.hold(bytes(3) * 10_000_000)
    hub.stall_after = 25_000_000
    with subprocess.Popen(**hub.command(NAME, home=tmp_path), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as killed:
        assert hub.stalled.wait(60)
        deadline = time.monotonic() + 60
        while not (found := parts(tmp_path)) or found[0].stat().st_size < 20 << 20:  # the library writes 10 MiB at a time
            assert time.monotonic() < deadline
            time.sleep(0.01)
        killed.kill()
    (part,) = parts(tmp_path)
    has = part.stat().st_size
    hub.stall_after = None
    hub.goes_on.set()
    assert not list(tmp_path.rglob("*.gguf")) and hub.run("--list", home=tmp_path).stdout == ""
    done = hub.run(NAME, home=tmp_path)
    assert done.returncode == 0, done.stderr
    ranges = [asked for method, path, asked in hub.asked if (method, path) == ("GET", "/cdn/file")]
    assert ranges == [None, f"bytes={has}-"] and has >= 20 << 20
    assert open(done.stdout.strip(), "rb").read() == hub.data and not parts(tmp_path)


@of_python
def test_what_is_left_of_a_file_that_is_not_asked_for_any_more_goes_with_the_next_pull(hub, tmp_path):
    blobs = tmp_path / "hub/models--someone--policy/blobs"
    blobs.mkdir(parents=True)
    (blobs / ("0" * 64 + ".part")).write_bytes(b"begun")
    assert hub.run(NAME, home=tmp_path).returncode == 0 and not parts(tmp_path)


@of_python
@pytest.mark.parametrize("what, value, words", [
    ("path", "../../../../escaped.gguf", "files with plain names"),
    ("path", "/escaped.gguf", "files with plain names"),
    ("path", "a\x1b]0;owned\x07.gguf", "files with plain names"),
    ("path", "a\n.gguf", "files with plain names"),
    ("path", "x" * 300 + ".gguf", "files with plain names"),
    ("stated", "../../../../escaped", "a digest in hexadecimal"),
    ("stated", "\x1b[2J", "a digest in hexadecimal"),
    ("commit", "../../../../escaped", "a commit of 40 hexadecimal digits"),
])  # fmt: skip
def test_names_and_digests_of_a_hub_reach_neither_path_nor_terminal(hub, tmp_path, what, value, words):
    setattr(hub, what, value)
    home = tmp_path / "a/b/c/d"
    done = hub.run(NAME, home=home)
    assert done.returncode == 9 and words in done.stderr and done.stdout == "", done.stderr
    assert all(line.isprintable() for line in done.stderr.splitlines())
    assert [path.name for path in tmp_path.iterdir()] in ([], ["a"]) and not list(tmp_path.rglob("*escaped*"))


@of_python
def test_a_hub_that_sends_more_than_it_lists_does_not_fill_the_disk(hub, tmp_path):
    hub.listed = listed = len(hub.data)
    hub.data += bytes(100 << 20)
    done = hub.run(NAME, home=tmp_path)
    assert done.returncode == 9, done.stderr
    assert sum(path.stat().st_size for path in tmp_path.rglob("*") if path.is_file() and not path.is_symlink()) <= listed + (1 << 20)


@of_python
def test_bytes_of_the_cache_that_have_changed_are_fetched_again(hub, tmp_path):
    file = hub.run(NAME, home=tmp_path).stdout.strip()
    blob = os.path.realpath(file)
    os.chmod(blob, 0o644)
    with open(blob, "r+b") as data:
        data.write(b"other")
    assert hub.run(NAME, home=tmp_path).returncode == 0
    assert open(file, "rb").read() == hub.data


@of_python
def test_other_bytes_than_the_hub_states_are_removed(hub, tmp_path):
    hub.data = hub.data[:-1] + bytes([hub.data[-1] ^ 1])
    done = hub.run(NAME, home=tmp_path)
    assert done.returncode == 9 and "expected bytes of SHA-256" in done.stderr
    assert hub.run("--list", home=tmp_path).stdout == "" and not list(tmp_path.rglob("*.gguf"))


@of_python
def test_what_the_hub_refuses_is_told(hub, tmp_path):
    hub.refuses = True
    done = hub.run(NAME, home=tmp_path)
    assert done.returncode == 9 and "expected a reachable hub repository" in done.stderr
    assert "401" in done.stderr or "token" in done.stderr


@of_python
def test_a_pulled_bundle_needs_no_hub(hub, tmp_path):
    assert hub.run(NAME, home=tmp_path).returncode == 0
    assert hub.run(NAME, home=tmp_path, HF_HUB_OFFLINE="1").returncode == 0


@pytest.mark.parametrize("name", ["hub:policy", "hub:a/b", "hub:../x@main", "hub:a/b@../../etc", "hub:a/b@x/../../etc", "hub:a/b@", "hub:" + "a" * 60_000, "hub:" + "a/" * 30_000 + "b@c"], ids=lambda name: name[:20])
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

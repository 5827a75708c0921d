# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What a server shows of itself: metrics, readiness, log, trace and recording, each through the tool that would read it."""

import http.client
import json
import os
import signal
import socket
import subprocess
import time
import urllib.error
import urllib.request
from pathlib import Path

import pytest
import wire
import zmq
from prometheus_client.parser import text_string_to_metric_families
from serve_test import Server

LOCAL = ("--bind", "tcp://127.0.0.1:0", "--threads", "2")


@pytest.fixture
def serve(vla, golden):
    servers = []

    def start(*args):
        servers.append(Server(vla, golden.bundle, *LOCAL, *args))
        return servers[-1]

    yield start
    for server in servers:
        server.process.kill()
        server.process.communicate()


@pytest.fixture
def talk():
    """Sends requests to a server in turn and returns the kinds of the answers."""
    peers = []

    def ask(server, *requests):
        peers.append(wire.Peer(server.ready["address"]))
        return [wire.kind(peers[-1].ask(request)) for request in requests]

    yield ask
    for peer in peers:
        peer.close()


def get(address, path, method="GET"):
    """(status, body, content type)"""
    request = urllib.request.Request(f"http://{address}{path}", method=method)
    try:
        with urllib.request.urlopen(request, timeout=20) as answer:
            return answer.status, answer.read().decode(), answer.headers["Content-Type"]
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode(), error.headers["Content-Type"]


def samples(text):
    """{(name, ((label, value), ...)): number} of a scrape."""
    return {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def scrape(server, enough):
    """The first scrape that has enough: an answer is counted after it is sent."""
    for _ in range(200):
        found = samples(get(server.ready["metrics"], "/metrics")[1])
        if enough(found):
            break
        time.sleep(0.05)
    return found


# --- metrics -----------------------------------------------------------------------------------------------------------------


def test_a_scrape_counts_requests_by_kind_and_code_and_times_every_stage(serve, talk, golden):
    server = serve("--metrics", "127.0.0.1:0")
    act = wire.act(1, golden, seed=1)
    requests = [act, act, wire.act(2, golden, has_text=False), wire.health(3), b"\xff\xff garbage"]
    assert talk(server, *requests) == ["chunk", "chunk", "error", "health", "error"]
    status, _, content_type = get(server.ready["metrics"], "/metrics")
    assert status == 200 and content_type.startswith("text/plain; version=0.0.4")

    def name(kind, code):
        return "vla_requests_total", (("code", code), ("kind", kind))

    found = scrape(server, lambda found: found.get(name("unknown", "bad_request")))

    def count(kind, code):
        return found.get(name(kind, code))

    assert count("act", "ok") == 2 and count("act", "bad_observation") == 1
    assert count("health", "ok") == 1 and count("unknown", "bad_request") == 1
    for stage in ("queue", "decode", "preprocess", "tokenize", "prefix", "steps", "postprocess", "total"):
        assert found["vla_stage_seconds_count", (("stage", stage),)] >= 2, stage
    total, steps = (found["vla_stage_seconds_sum", (("stage", s),)] for s in ("total", "steps"))
    assert 0 < steps < total < 60
    assert found["vla_received_bytes_total", ()] == sum(map(len, requests))
    assert found["vla_clients_total", ()] == 1 and found["vla_queue_depth", ()] == 0 and found["vla_ready", ()] == 1
    assert found["process_resident_memory_bytes", ()] > 1e6
    info = {name: dict(labels) for name, labels in found if name.endswith("_info")}
    assert info["vla_bundle_info"]["arch"] == "smolvla" and info["vla_bundle_info"]["checksum"].startswith("xxh3:")
    assert info["vla_runtime_info"]["kernels"] == server.ready["kernels"]
    assert set(info) == {"vla_build_info", "vla_bundle_info", "vla_runtime_info"}


def test_http_has_three_pages_and_reads_only(serve):
    address = serve("--metrics", "127.0.0.1:0").ready["metrics"]
    assert get(address, "/healthz")[:2] == (200, "ok\n") and get(address, "/readyz")[:2] == (200, "ready\n")
    assert get(address, "/etc/passwd")[0] == 404 and get(address, "/metrics", "POST")[0] == 405
    assert get(address, "/metrics", "HEAD")[:2] == (200, "")


def readiness(vla, golden):
    """What /readyz says from the start of a server to its end, while forty clients wait for it to drain."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        address = "127.0.0.1:%d" % probe.getsockname()[1]
    process = subprocess.Popen(
        [vla.path, "serve", golden.bundle, *LOCAL, "--metrics", address],
        env=vla.environment, stdout=subprocess.PIPE, text=True, preexec_fn=lambda: os.nice(19),
    )  # fmt: skip
    peers, seen = [], []

    def look():
        try:
            seen.append(get(address, "/readyz")[:2])
            return True
        except (OSError, http.client.HTTPException):  # a server that is going away may cut its answer off
            return False

    try:
        while not seen or seen[-1][0] != 200:
            assert look() or process.poll() is None
        line = process.stdout.readline()
        assert line.startswith("ready ") and get(address, "/healthz")[0] == 200
        peers = [wire.Peer(line.split("address=")[1].split()[0]) for _ in range(40)]
        for i, peer in enumerate(peers):
            peer.socket.send(wire.act(i, golden, seed=1))
        peers[0].socket.recv()
        process.send_signal(signal.SIGTERM)
        while look():
            pass
        assert process.wait(30) == 0
    finally:
        process.kill()
        process.communicate()
        for peer in peers:
            peer.close()
    return seen


def test_readiness_is_denied_until_the_bundle_is_loaded_and_warm_and_again_while_the_server_drains(vla, golden):
    states = [(503, "loading\n"), (503, "warming up\n"), (200, "ready\n"), (503, "draining\n")]
    for _ in range(10):  # on a busy machine a look may come after a state has passed
        seen = list(dict.fromkeys(readiness(vla, golden)))
        assert seen == [state for state in states if state in seen]
        if seen[0][0] == 503 and seen[-1] == states[-1]:
            return
    pytest.fail(f"expected a server that is not ready before and after, found {seen}")


def test_http_that_others_reach_needs_insecure_and_an_address_that_is_one(vla, golden):
    for address in ("0.0.0.0:0", "*:0", "[::]:0"):
        vla("serve", golden.bundle, *LOCAL, "--metrics", address).refused("usage", "--metrics", "--insecure")
    for address in ("9090", "localhost:9090", "127.0.0.1:x", "127.0.0.1:99999", "lo:1", "127.0.0.1:0,80"):
        vla("serve", golden.bundle, *LOCAL, f"--metrics={address}").refused("usage", "ADDRESS:PORT")


def test_a_trace_that_cannot_be_written_is_refused_before_the_bundle_is_loaded(vla, tmp_path):
    vla("serve", "no.gguf", *LOCAL, "--trace", tmp_path / "no" / "out.json").refused("io", "out.json")


def test_a_metrics_address_in_use_is_an_io_error(vla, golden):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        address = "127.0.0.1:%d" % taken.getsockname()[1]
        vla("serve", golden.bundle, *LOCAL, "--metrics", address).refused("io", address, "--metrics")


def stack_left(process, task):
    """Bytes between a waiting thread's stack pointer and the end of its stack; None while it runs."""
    numbers = (task / "syscall").read_text().split()
    if len(numbers) < 3:
        return None
    pointer = int(numbers[-2], 16)
    for line in (process / "maps").read_text().splitlines():
        low, high = (int(end, 16) for end in line.split()[0].split("-"))
        if low <= pointer < high:
            return pointer - low
    raise AssertionError(f"no memory at {pointer:#x}")


def test_every_thread_of_a_server_has_a_stack_of_megabytes(serve, talk, golden, tmp_path):
    server = serve("--metrics", "127.0.0.1:0", "--log", "json", "--trace", tmp_path / "t.json", "--record", tmp_path / "r")
    talk(server, wire.act(1, golden, seed=1))
    get(server.ready["metrics"], "/metrics")
    process = Path("/proc", str(server.process.pid))
    tasks = [task for task in (process / "task").iterdir() if task.name != process.name]  # the first one's grows by itself
    assert len(tasks) >= 5  # I/O, three writers and the monitor
    left = dict.fromkeys(tasks)
    for _ in range(200):
        try:
            left |= {task: stack_left(process, task) for task in tasks if left[task] is None}
        except PermissionError:
            pytest.skip("this system lets nobody look at the stack pointers of a child process")
        if None not in left.values():
            break
        time.sleep(0.05)
    assert min(left.values()) >= 1 << 20, {(task / "comm").read_text(): n for task, n in left.items()}


def test_slow_and_broken_http_clients_disturb_neither_acts_nor_later_scrapes(serve, talk, golden):
    server = serve("--metrics", "127.0.0.1:0")
    host, port = server.ready["metrics"].rsplit(":", 1)
    slow = [socket.create_connection((host, int(port))) for _ in range(12)]
    for connection in slow:
        connection.sendall(b"GET /metrics HTTP/1.1\r\nHost: x")
    hostile = socket.create_connection((host, int(port)))
    try:
        hostile.sendall(b"\0\xff" * 100_000)
    except OSError:
        pass  # it may well hang up before it has read all that
    assert talk(server, wire.act(1, golden, seed=1)) == ["chunk"]
    assert get(server.ready["metrics"], "/healthz")[0] == 200
    for connection in [*slow, hostile]:
        connection.close()


# --- log ---------------------------------------------------------------------------------------------------------------------


def log_of(server):
    code, _, err = server.stop(signal.SIGTERM)
    assert code == 0
    return err.splitlines()


def test_the_json_log_has_the_course_of_events_one_object_a_line(serve, talk, golden):
    server = serve("--log", "json", "--log-level", "debug")
    hostile = "a\nb\x1b[31m\"},{\u2028" + "\u00fc"
    act = wire.act(7, golden, seed=1)
    not_text = act.replace(golden.text.encode(), b"\xff" * len(golden.text))
    assert talk(server, act, wire.act(8, golden, text=hostile), not_text) == ["chunk", "chunk", "error"]
    events = [json.loads(line) for line in log_of(server)]
    assert [e["event"] for e in events] == ["start", "loaded", "ready", "request", "request", "request", "shutdown"]
    assert all(e["time"].endswith("Z") and e["level"] in ("debug", "info", "warn", "error") for e in events)
    first, _, refused = events[3:6]
    assert (first["request_id"], first["kind"], first["code"], first["level"]) == (7, "act", "ok", "debug")
    assert first["bytes_in"] == len(act) and 0 < first["engine_ms"] <= first["total_ms"]
    assert refused["level"] == "warn" and refused["code"] == "bad_request" and refused["where"]
    assert events[-1]["chunks"] == 2 and events[-1]["errors"] == 1


def test_the_log_tells_robots_apart_and_knows_of_a_request_that_was_too_large(serve, talk, golden):
    server = serve("--log", "json", "--log-level", "debug", "--max-message", 1)
    too_large = wire.act(9, golden, text="x" * 2_000_000)
    assert talk(server, wire.hello(1, "left-arm", "2.1"), wire.act(2, golden, seed=1), too_large) == ["hello", "chunk", "error"]
    assert talk(server, wire.hello(1, "right-arm", ""), wire.health(2)) == ["hello", "health"]
    requests = [e for e in map(json.loads, log_of(server)) if e["event"] == "request"]
    assert [e["name"] for e in requests] == ["left-arm 2.1"] * 3 + ["right-arm"] * 2
    assert len({e["client"] for e in requests}) == 2 and {e["peer"] for e in requests} == {"127.0.0.1"}
    refused = requests[2]
    assert (refused["request_id"], refused["code"], refused["level"]) == (9, "too_large", "warn")
    assert refused["found"] == str(len(too_large))


def test_what_a_client_sends_cannot_break_a_line(serve, talk, golden):
    server = serve("--log", "text")
    act = wire.act(1, golden, seed=1)
    name = next(iter(golden.images)).encode()
    hostile = b"\n2026 \x1b[2J\xc3"[: len(name)].ljust(len(name), b"x")
    assert talk(server, act.replace(name, hostile), b"\n\n") == ["error", "error"]
    text = log_of(server)
    assert len(text) == 6 and all(line.isascii() and line.isprintable() for line in text), text


def test_without_log_only_trouble_is_told(serve, talk, golden):
    server = serve()
    assert talk(server, wire.act(1, golden, seed=1), b"garbage") == ["chunk", "error"]
    (line,) = log_of(server)
    assert "warn" in line and "code=bad_request" in line


def test_a_client_whose_key_is_not_listed_is_logged_and_counted(vla, serve, tmp_path):
    secret, public = vla("keygen", tmp_path / "server").out.splitlines()
    server = serve("--curve-secret", secret, "--curve-clients", public, "--log", "json", "--metrics", "127.0.0.1:0")
    client = zmq.Context.instance().socket(zmq.DEALER)
    client.linger = 0
    client.curve_publickey, client.curve_secretkey = zmq.curve_keypair()
    client.curve_serverkey = Path(public).read_bytes().split()[0]
    client.connect(server.ready["address"])
    refused_clients = "vla_refused_clients_total", ()
    n = scrape(server, lambda found: found[refused_clients] > 0)[refused_clients]
    client.close()
    refused = [event for event in map(json.loads, log_of(server)) if event["event"] == "dropped"]
    assert n >= 1 and refused[0] == {**refused[0], "level": "warn", "why": "key", "peer": "127.0.0.1"}


# --- trace -------------------------------------------------------------------------------------------------------------------


def test_a_trace_is_json_whose_stages_lie_inside_their_act(serve, talk, golden, tmp_path):
    path = tmp_path / "out.json"
    server = serve("--trace", path)
    talk(server, wire.act(1, golden, seed=1), wire.health(2), wire.act(3, golden, seed=2))
    assert server.stop(signal.SIGTERM)[0] == 0
    events = json.loads(path.read_text())
    assert {e["args"]["name"] for e in events if e["ph"] == "M"} == {"requests", "engine", "host, beside a device", "vla serve"}
    slices = [(e["name"], round(e["ts"] * 1e3), round((e["ts"] + e["dur"]) * 1e3)) for e in events if e["ph"] == "X"]
    acts, stages = ([s for s in slices if (s[0] == "act") == want] for want in (True, False))
    assert len(acts) == 2 and {"decode", "prefix", "steps"} <= {name for name, *_ in stages}
    for _, start, end in stages:
        assert start <= end and any(a <= start and end <= b for _, a, b in acts)
    tracks = {}
    for e in events:
        if e["ph"] in "be":
            tracks.setdefault(e["id"], []).append((e["name"], e["ph"], e["ts"]))
    assert len(tracks) == 3
    for track in tracks.values():
        (_, _, received), (_, _, sent) = track[:2]
        assert all(received <= ts <= sent for _, _, ts in track)
    assert [name for name, ph, _ in tracks[1] if ph == "b"] == ["act", "queue", "compute", "send"]


def test_the_trace_of_a_killed_server_lacks_the_end_only(serve, talk, golden, tmp_path):
    path = tmp_path / "out.json"
    server = serve("--trace", path)
    talk(server, wire.act(1, golden, seed=1))
    for _ in range(100):
        if '"steps"' in path.read_text():
            break
        time.sleep(0.05)
    server.stop(signal.SIGKILL)
    events = json.loads(path.read_text().rstrip().rstrip(",") + "]")
    assert {e["ph"] for e in events} == {"M", "b", "e", "X"}


# --- recording ---------------------------------------------------------------------------------------------------------------


@pytest.fixture
def recording(serve, talk, golden, tmp_path):
    """Three acts (a seed; none; a deadline), a refusal, garbage, a description and a health."""
    folder = tmp_path / "recording"
    server = serve("--record", folder)
    requests = [
        wire.act(1, golden, seed=5), wire.act(2, golden), wire.act(3, golden, deadline_ms=60_000),
        wire.act(4, golden, has_text=False), b"garbage", wire.describe(6), wire.health(7),
    ]  # fmt: skip
    kinds = talk(server, *requests)
    assert kinds == ["chunk", "chunk", "chunk", "error", "error", "description", "health"]
    assert server.stop(signal.SIGTERM)[0] == 0
    return folder


def test_a_replay_gives_every_answer_again_bit_for_bit(vla, serve, golden, recording):
    answer = vla("replay", recording, "--bundle", golden.bundle, "--threads", 2)
    assert (answer.code, answer.out) == (0, "6 answers the same, 0 different, 1 not compared\n"), answer.err
    answer = vla("replay", recording, "--connect", serve().ready["address"])
    assert (answer.code, answer.out) == (0, "6 answers the same, 0 different, 1 not compared\n"), answer.err


def with_record(recording, index, change, of_request=False):
    """Changes the answer, or the request, of one record and seals it again, as src/serve/recording.h describes."""
    import struct

    import xxhash

    path = recording / "requests.vlarec"
    data = bytearray(path.read_bytes())
    at = 8
    for _ in range(index):
        n_in, n_out = struct.unpack_from("<II", data, at + 8)
        at += 40 + n_in + n_out
    n_in, n_out = struct.unpack_from("<II", data, at + 8)
    start, middle, end = at + 40, at + 40 + n_in, at + 40 + n_in + n_out
    part = slice(start, middle) if of_request else slice(middle, end)
    changed = change(bytes(data[part]))
    assert len(changed) == part.stop - part.start
    data[part] = changed
    seal = 0
    for sealed in (slice(at, at + 32), slice(start, middle), slice(middle, end)):
        seal = xxhash.xxh3_64_intdigest(bytes(data[sealed]), seal)
    struct.pack_into("<Q", data, at + 32, seal)
    path.write_bytes(data)


def test_one_bit_of_one_action_is_found_and_told(vla, golden, recording):
    def flip(answer):
        at = 40  # inside the packed actions, which come after version, number, horizon and width
        return answer[:at] + bytes([answer[at] ^ 1]) + answer[at + 1 :]

    with_record(recording, 2, flip)
    answer = vla("replay", recording, "--bundle", golden.bundle, "--threads", 2)
    assert answer.code == 10
    assert "5 answers the same, 1 different, 1 not compared" in answer.out and " actions " in answer.out
    assert "request 2: actions" in answer.err and "1 answers differ" in answer.err


def test_a_recording_under_limits_that_no_server_has_is_refused(vla, golden, recording):
    of_32_mib, of_one = b"\x80\x80\x80\x10", b"\x81\x80\x80\x00"  # as Protobuf writes them in four bytes
    with_record(recording, 0, lambda description: description.replace(of_32_mib, of_one), of_request=True)
    answer = vla("replay", recording, "--bundle", golden.bundle, "--threads", 2)
    assert answer.code == 11 and "limits that vla serve takes, found 1 bytes, 16777216 pixels" in answer.err


@pytest.mark.parametrize("place", [0, 3, 20, 40, 50, 5000, -1, -20])
def test_a_damaged_recording_is_refused_with_its_place(vla, golden, recording, place):
    path = recording / "requests.vlarec"
    data = bytearray(path.read_bytes())
    data[place] ^= 1
    path.write_bytes(data)
    answer = vla("replay", recording, "--bundle", golden.bundle, "--threads", 2)
    assert answer.code == 11 and "requests.vlarec: record" in answer.err and "at byte" in answer.err


def test_a_recording_that_was_cut_is_refused_and_its_whole_part_can_be_replayed(vla, golden, recording):
    path = recording / "requests.vlarec"
    data = path.read_bytes()
    path.write_bytes(data[:-46])
    answer = vla("replay", recording, "--bundle", golden.bundle, "--threads", 2)
    assert answer.code == 11 and "the end of the file" in answer.err and "--first 6" in answer.err
    assert vla("replay", recording, "--bundle", golden.bundle, "--threads", 2, "--first", 6).code == 0
    path.write_bytes(data[:-40])
    answer = vla("replay", recording, "--bundle", golden.bundle, "--threads", 2)
    assert answer.code == 0 and "the recording has no end" in answer.out


def test_other_kernels_are_announced(vla, golden, recording):
    answer = vla("replay", recording, "--bundle", golden.bundle, "--threads", 2, "--kernels", "ggml")
    recorded = vla("replay", recording, "--bundle", golden.bundle, "--threads", 1)
    assert "note: device was cpu, 2 threads when recorded, is cpu, 1 thread" in recorded.out
    if "kernels" in answer.out:
        assert "is ggml now" in answer.out


def test_a_recording_is_never_written_over_and_stops_at_its_limit(vla, serve, talk, golden, recording, tmp_path):
    vla("serve", golden.bundle, *LOCAL, "--record", recording).refused("io", "requests.vlarec")
    folder = tmp_path / "small"
    server = serve("--record", folder, "--record-limit", 1)
    size = len(wire.act(1, golden, text="x" * 4000))
    n = 1_200_000 // size
    assert set(talk(server, *(wire.act(i, golden, text="x" * 4000) for i in range(n)))) == {"chunk"}
    note, line = log_of(server)  # the long instruction was cut, which is told once
    assert " note " in note and "record_stopped" in line and "limit" in line
    assert (folder / "requests.vlarec").stat().st_size <= 1_000_000
    answer = vla("replay", folder, "--bundle", golden.bundle, "--threads", 2, "--first", 3)
    assert answer.code == 0, answer.err


def test_a_server_that_is_not_there_is_noticed_within_seconds(vla, recording):
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    answer = vla("replay", recording, "--connect", f"tcp://127.0.0.1:{port}")
    answer.refused("io", "is a server running there?")
    assert answer.seconds < 30


def test_what_is_no_recording_and_a_server_that_is_not_there_are_refused(vla, tmp_path):
    vla("replay", tmp_path).refused("io", "requests.vlarec")
    vla("replay", tmp_path, "--bundle", "x", "--connect", "y").refused("usage")

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What our clients take from a server that is not `vla serve`: calls that end in time, finite actions, texts that a terminal shows."""

import base64
import contextlib
import hashlib
import resource
import socket
import struct
import subprocess
import threading
import time

import msgpack
import numpy as np
import pytest

pytest.importorskip("websockets")

from drop_in import openpi_array, pack  # noqa: E402
from faulty_server import chunk, response  # noqa: E402
from hostile import HANDSHAKE, long_frame, websocket_frame  # noqa: E402
from server_process import SECONDS, VLA, Robot, Server  # noqa: E402

import vla_cpp  # noqa: E402
from vla_cpp import wire  # noqa: E402
from vla_cpp.msgpack_message import MAX_DEPTH, MAX_VALUES, unpack  # noqa: E402

ESCAPES = "\x1b]0;owned\x07\x1b[2J\nready \u202e"
TIMEOUT, SLACK = 1.0, 1.5  # seconds; what a busy machine may add


def text(payload):
    return websocket_frame(0x81, payload, is_masked=False)


def binary(payload):
    return websocket_frame(0x82, payload, is_masked=False)


@contextlib.contextmanager
def listening(handle):
    """A server of sockets: `handle` has each connection, until the test is over."""
    over = threading.Event()
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve():
            while True:
                try:
                    raw, _ = listener.accept()
                except OSError:
                    return
                threading.Thread(target=one, args=(raw,), daemon=True).start()

        def one(raw):
            with raw, contextlib.suppress(OSError):
                handle(raw, over)

        threading.Thread(target=serve, daemon=True).start()
        try:
            yield listener.getsockname()[1]
        finally:
            over.set()
            listener.shutdown(socket.SHUT_RDWR)


def accept(raw):
    """The handshake of a WebSocket."""
    head = b""
    while b"\r\n\r\n" not in head:
        head += raw.recv(4096)
    key = head.split(b"Sec-WebSocket-Key: ")[1].split(b"\r\n")[0]
    told = base64.b64encode(hashlib.sha1(key + b"258EAFA5-E914-47DA-95CA-C5AB0DC85B11").digest())
    raw.sendall(b"HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Accept: " + told + b"\r\n\r\n")


def openpi(behave, metadata=b"\x80"):
    """A server that greets, and then behaves like this."""

    def handle(raw, over):
        accept(raw)
        raw.sendall(binary(metadata))
        behave(raw, over)

    return listening(handle)


def for_ever(piece, pause=0.0):
    def behave(raw, over):
        while not over.wait(pause):
            raw.sendall(piece)

    return behave


def once(data):
    def behave(raw, over):
        raw.recv(1 << 16)
        raw.sendall(data)
        over.wait()

    return behave


def act(policy, **more):
    return policy.act(images={}, state={"arm": [1.0]}, text="go", **more)


SLOW = {
    "never answers": lambda raw, over: over.wait(),
    "drips": for_ever(b"\x00", 0.05),
    "drips an answer": lambda raw, over: [raw.sendall(binary(bytes(1000))[:4]), for_ever(b"\x00", 0.05)(raw, over)],
    "sends half a frame": once(binary(bytes(100))[:50]),
    "sends half a message": once(websocket_frame(0x02, b"x" * 100, is_masked=False)),
    "sends empty pieces": lambda raw, over: [
        raw.sendall(websocket_frame(0x02, b"", is_masked=False)), for_ever(websocket_frame(0x00, b"", is_masked=False) * 100)(raw, over)
    ],
    "pings and does not read": for_ever(websocket_frame(0x89, b"?" * 100, is_masked=False) * 100),
}  # fmt: skip


@pytest.mark.parametrize("behaviour", SLOW)
def test_an_act_ends_in_time_at_a_server_that(behaviour):
    with openpi(SLOW[behaviour]) as port, vla_cpp.OpenpiClient(f"openpi://127.0.0.1:{port}", ["state=arm", "prompt=text"]) as policy:
        start = time.monotonic()
        with pytest.raises((vla_cpp.Timeout, vla_cpp.Disconnected)):
            act(policy, timeout=TIMEOUT)
        assert time.monotonic() - start < TIMEOUT + SLACK


def test_an_act_ends_in_time_at_a_server_that_does_not_read():
    frame = np.zeros((3000, 3000, 3), np.uint8)  # more than the system buffers
    with openpi(lambda raw, over: over.wait()) as port:
        with vla_cpp.OpenpiClient(f"openpi://127.0.0.1:{port}", ["image=top"]) as policy:
            start = time.monotonic()
            with pytest.raises(vla_cpp.Timeout):
                policy.act(images={"top": frame}, state={}, text="", timeout=TIMEOUT)
            assert time.monotonic() - start < TIMEOUT + SLACK


@pytest.mark.parametrize("begin", [b"", b"HTTP/1.1 101 Switching", b"HTTP/1.1 200 OK\r\n\r\n" + b"x" * 100], ids=["silence", "half", "a page"])
def test_connecting_ends_in_time(begin):
    def handle(raw, over):
        raw.sendall(begin)
        for_ever(b"x", 0.05)(raw, over)

    with listening(handle) as port:
        start = time.monotonic()
        with pytest.raises((vla_cpp.Timeout, vla_cpp.Disconnected)):
            vla_cpp.OpenpiClient(f"openpi://127.0.0.1:{port}", ["state=arm"], timeout=TIMEOUT)
        assert time.monotonic() - start < TIMEOUT + SLACK


def test_a_turn_that_another_thread_has_is_waited_for_no_longer_than_the_time_given():
    with openpi(lambda raw, over: over.wait()) as port:
        with vla_cpp.OpenpiClient(f"openpi://127.0.0.1:{port}", ["state=arm", "prompt=text"]) as policy:
            raised = []

            def other():
                try:
                    act(policy, timeout=4)
                except vla_cpp.Timeout as problem:
                    raised.append(problem)

            thread = threading.Thread(target=other)
            thread.start()
            time.sleep(0.2)
            start = time.monotonic()
            with pytest.raises(vla_cpp.Timeout):
                act(policy, timeout=0.5)
            assert time.monotonic() - start < 2
            thread.join()
            assert raised


def rows(value):
    return np.full((2, 3), value)


def answered(message, metadata=None):
    return openpi(once(binary(message)), pack(metadata or {}, openpi_array))


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 1e30, 1e300])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_actions_that_are_none_do_not_reach_the_caller_of_openpi(value, dtype):
    with np.errstate(over="ignore"):
        told = rows(0.5).astype(dtype)
        told[1, 2] = value
    with answered(pack({"actions": told}, openpi_array)) as port:
        with vla_cpp.OpenpiClient(f"openpi://127.0.0.1:{port}", ["state=arm", "prompt=text"]) as policy:
            with pytest.raises(vla_cpp.BadAction):
                act(policy)


def test_a_far_action_comes_with_a_note():
    with answered(pack({"actions": rows(2e6)}, openpi_array), {"action_names": ["a", "b", "c"]}) as port:
        with vla_cpp.OpenpiClient(f"openpi://127.0.0.1:{port}", ["state=arm", "prompt=text"]) as policy:
            assert [note.split(",")[0] for note in act(policy).notes] == [f'action "{name}": 2e+06' for name in "abc"]


@pytest.mark.parametrize(
    "metadata, reply",
    [
        ({"action_horizon": 3, "action_dim": 3}, {}),
        ({"action_horizon": 2, "action_dim": 4}, {}),
        ({"action_names": ["a", "b"]}, {}),
        ({"action_names": "abc"}, {}),
        ({"control_hz": float("nan")}, {}),
        ({"control_hz": 1e30}, {}),
        ({"control_hz": -1}, {}),
        ({}, {"server_timing": {"queue_ms": float("nan")}}),
        ({}, {"policy_timing": {"infer_ms": "1"}}),
        ({}, {"seed": 1.5}),
        ({}, {"notes": "text"}),
    ],
    ids=str,
)
def test_an_answer_that_does_not_go_with_what_the_server_says_is_refused(metadata, reply):
    with answered(pack({"actions": rows(0.5), **reply}, openpi_array), metadata) as port:
        with pytest.raises(vla_cpp.Incompatible):
            with vla_cpp.OpenpiClient(f"openpi://127.0.0.1:{port}", ["state=arm", "prompt=text"]) as policy:
                act(policy)


def test_the_first_answer_binds_those_of_a_server_that_says_nothing():
    def behave(raw, over):
        for width in (3, 4):
            raw.recv(1 << 16)
            raw.sendall(binary(pack({"actions": np.ones((2, width))}, openpi_array)))

    with openpi(behave) as port, vla_cpp.OpenpiClient(f"openpi://127.0.0.1:{port}", ["state=arm", "prompt=text"]) as policy:
        assert act(policy).actions.shape == (2, 3)
        with pytest.raises(vla_cpp.Incompatible, match="shape"):
            act(policy)


def test_a_server_that_comes_back_with_another_policy_is_refused():
    greetings = [pack({"checksum": name}, openpi_array) for name in ("xxh3:1", "xxh3:2")]

    def handle(raw, over):
        accept(raw)
        raw.sendall(binary(greetings.pop(0)))
        raw.recv(1 << 16)
        raw.sendall(text(b"busy: later"))

    with listening(handle) as port, vla_cpp.OpenpiClient(f"openpi://127.0.0.1:{port}", ["state=arm", "prompt=text"]) as policy:
        with pytest.raises(vla_cpp.Busy):
            act(policy)
        with pytest.raises(vla_cpp.Incompatible, match="xxh3:2"):
            act(policy)


def test_what_the_server_says_before_it_is_asked_is_not_the_answer():
    told = [pack({"actions": rows(value)}, openpi_array) for value in (666.0, 1.0)]

    def handle(raw, over):
        accept(raw)
        raw.sendall(binary(b"\x80"))
        if len(told) == 2:
            raw.sendall(binary(told.pop(0)))
        raw.recv(1 << 16)
        raw.sendall(binary(told[0]))
        over.wait()

    with listening(handle) as port, vla_cpp.OpenpiClient(f"openpi://127.0.0.1:{port}", ["state=arm", "prompt=text"]) as policy:
        time.sleep(0.2)
        assert act(policy).actions[0, 0] == 1


def test_a_connection_that_the_server_ended_while_nothing_was_asked_is_made_again():
    def handle(raw, over):
        accept(raw)
        raw.sendall(binary(b"\x80"))
        raw.settimeout(0.3)
        with contextlib.suppress(TimeoutError):
            raw.recv(1 << 16)
            raw.sendall(binary(pack({"actions": rows(1.0)}, openpi_array)))
            over.wait()

    with listening(handle) as port, vla_cpp.OpenpiClient(f"openpi://127.0.0.1:{port}", ["state=arm", "prompt=text"]) as policy:
        time.sleep(0.6)
        assert act(policy).actions[0, 0] == 1


def texts_of(value):
    if isinstance(value, dict):
        return [t for pair in value.items() for part in pair for t in texts_of(part)]
    if isinstance(value, (list, tuple)):
        return [t for part in value for t in texts_of(part)]
    return [value] if isinstance(value, str) else []


def test_texts_of_an_openpi_server_are_shown_without_what_a_terminal_obeys():
    metadata = {"bundle": ESCAPES, "checksum": ESCAPES, "action_names": [ESCAPES] * 3, "other": [{ESCAPES: ESCAPES}]}
    reply = pack({"actions": rows(1.0), "notes": [ESCAPES]}, openpi_array)
    with answered(reply, metadata) as port:
        with vla_cpp.OpenpiClient(f"openpi://127.0.0.1:{port}", ["state=arm", "prompt=text"]) as policy:
            got = act(policy)
            seen = [policy.name, policy.identity, *got.names, *got.notes, got.bundle.name, *texts_of(policy.metadata)]
            assert len(seen) > 8 and all(t.isprintable() and "owned" in t for t in seen if t not in ("bundle", "checksum", "action_names", "other"))


@pytest.mark.parametrize(
    "data",
    [
        text(("late: " + ESCAPES).encode()),
        text(ESCAPES.encode()),
        binary(pack({"type": "error", "message": ESCAPES}, openpi_array)),
        binary(pack({ESCAPES: 1}, openpi_array)),
        binary(pack({"actions": {b"__ndarray__": True, b"data": b"", b"dtype": ESCAPES, b"shape": [1]}}, openpi_array)),
        websocket_frame(0x88, struct.pack(">H", 1011) + ESCAPES.encode(), is_masked=False),
    ],
    ids=["refusal", "traceback", "error", "keys", "dtype", "close"],
)
def test_errors_of_an_openpi_server_are_shown_without_what_a_terminal_obeys(data):
    with openpi(once(data)) as port, vla_cpp.OpenpiClient(f"openpi://127.0.0.1:{port}", ["state=arm", "prompt=text"]) as policy:
        with pytest.raises(vla_cpp.VlaError) as raised:
            act(policy)
        assert str(raised.value).isprintable()


N_BYTE = 60_000_000
LARGE = {
    "empty maps": b"\xdd" + struct.pack(">I", N_BYTE) + b"\x80" * N_BYTE,
    "nothings": b"\xdd" + struct.pack(">I", N_BYTE) + b"\xc0" * N_BYTE,
    "lists in lists": b"\x91" * N_BYTE,
    "lists that announce much": b"\xdc\xff\xff" * (N_BYTE // 3),
    "keys": b"\xdf" + struct.pack(">I", 1 << 16) + b"".join(b"\xcd" + struct.pack(">H", n) + b"\x80" for n in range(1 << 16)),
}


@pytest.mark.parametrize("name", LARGE)
def test_messages_of_many_values_are_refused_at_once(name):
    """The fastest of three: bytes are copied beside other work."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    seconds = []
    for _ in range(3):
        start = time.process_time()
        with pytest.raises(vla_cpp.Incompatible, match="more than (4096 values|8 levels)"):
            unpack(LARGE[name], "server")
        seconds.append(time.process_time() - start)
    assert min(seconds) < 0.5
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100 << 10  # KiB: a copy of the bytes


def test_the_limits_admit_what_they_say():
    assert len(unpack(msgpack.packb([0] * (MAX_VALUES - 1)), "x")) == MAX_VALUES - 1
    with pytest.raises(vla_cpp.Incompatible, match="values"):
        unpack(msgpack.packb([0] * MAX_VALUES), "x")
    assert unpack(b"\x91" * MAX_DEPTH + b"\x00", "x")
    with pytest.raises(vla_cpp.Incompatible, match="levels"):
        unpack(b"\x91" * (MAX_DEPTH + 1) + b"\x00", "x")


@pytest.mark.parametrize(
    "data",
    [
        {"nd": True, "type": "<f4", "shape": [2], "data": bytes(4)},
        {"nd": True, "type": "<f4", "shape": [-1], "data": bytes(4)},
        {"nd": True, "type": "<f4", "shape": [1 << 40, 1 << 40], "data": bytes(4)},
        {"nd": True, "type": "<f4", "shape": 1, "data": bytes(4)},
        {"nd": True, "type": "<f4", "shape": [1], "data": [1.0]},
        {"nd": True, "type": "<f16", "shape": [1], "data": bytes(16)},
        {"nd": True, "type": "(1000000,)f4", "shape": [1], "data": bytes(16)},
        {"nd": True, "type": "f4," * 100_000, "shape": [1], "data": bytes(16)},
        {"nd": True, "type": ["<f4"], "shape": [1], "data": bytes(4)},
        {"nd": True, "shape": [1], "data": bytes(4)},
        {"__npgeneric__": True, "dtype": "<f4", "data": {"a": 1}},
        {"nd": True},
        msgpack.ExtType(4, b"x"),
        msgpack.Timestamp(1),
    ],
    ids=lambda data: str(data)[:60],
)
def test_arrays_that_are_none_are_refused(data):
    with pytest.raises(vla_cpp.Incompatible):
        unpack(msgpack.packb({"x": data}), "server")


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("letter", "?bBhHiIlLqQefdU")
def test_every_dtype_comes_as_it_was_sent(letter, order):
    dtype = np.dtype(letter + "7" * (letter == "U")).newbyteorder(order)
    array = np.arange(6).reshape(2, 3).astype(dtype)
    for framing in ({"__ndarray__": True, "dtype": dtype.str}, {"nd": True, "type": dtype.str}):
        got = unpack(msgpack.packb({**framing, "shape": [2, 3], "data": array.tobytes()}), "server")
        assert got.dtype == dtype and (got == array).all()


def test_an_answer_larger_than_the_limit_ends_before_it_is_taken():
    sent = []

    def behave(raw, over):
        raw.recv(1 << 16)
        for piece in [binary(bytes(N_BYTE))[:10], *[bytes(1 << 20)] * 60]:
            raw.sendall(piece)
            sent.append(len(piece))

    with openpi(behave) as port, vla_cpp.OpenpiClient(f"openpi://127.0.0.1:{port}", ["state=arm", "prompt=text"]) as policy:
        with pytest.raises(vla_cpp.Disconnected, match="frame|size|larg|big|limit"):
            act(policy)
        assert sum(sent) < 30 << 20


# --- the native protocol -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e30, -1e30])
def test_actions_that_are_none_do_not_reach_the_caller(faulty, value):
    faulty.on_act = lambda request: [response(request, chunk=chunk(value))]
    with vla_cpp.Client(faulty.address, timeout=SECONDS) as policy, pytest.raises(vla_cpp.BadAction):
        policy.act(images={"top": np.zeros((64, 64, 3), np.uint8)}, state=[0, 0], text="go")


@pytest.mark.parametrize("field, value", [("horizon", 1 << 20), ("rate_hz", float("nan")), ("rate_hz", 1e30), ("rate_hz", -1), ("d_noise", 1 << 31)])
def test_a_description_that_no_policy_has_is_refused(faulty, field, value):
    setattr(faulty.description, field, value)
    with vla_cpp.Client(faulty.address, timeout=SECONDS) as policy, pytest.raises(vla_cpp.Incompatible):
        policy.spec  # noqa: B018


def test_texts_of_a_description_are_shown_without_what_a_terminal_obeys(faulty):
    d = faulty.description
    d.views[0].name = d.states[0].name = d.actions[0].name = d.actions[1].unit = d.noise_kind = d.runtime.device = ESCAPES
    with vla_cpp.Client(faulty.address, timeout=SECONDS) as policy:
        spec = policy.spec
    assert all(t.isprintable() for t in (spec.views[0].name, spec.states[0].name, *spec.action_names, *spec.action_units, spec.noise, spec.device))


def test_an_answer_of_many_parts_is_refused_at_once(faulty):
    told = chunk(1)
    told.notes.extend([""] * 2_000_000)
    faulty.on_act = lambda request: [response(request, chunk=told)]
    with vla_cpp.Client(faulty.address, timeout=SECONDS) as policy, pytest.raises(vla_cpp.Incompatible, match="parts"):
        policy.act(images={"top": np.zeros((64, 64, 3), np.uint8)}, state=[0, 0], text="go")


def native(behave):
    def handle(raw, over):
        raw.sendall(HANDSHAKE.replace(b"DEALER", b"ROUTER"))
        behave(raw, over)

    return listening(handle)


def native_slow():
    late = response(type("Request", (), {"request_id": 1, "act": None})(), health={}).SerializeToString()
    unasked = bytes([0, len(late)]) + late
    return {
        "is silent": lambda raw, over: over.wait(),
        "drips": for_ever(b"\x00", 0.05),
        "sends half a frame": lambda raw, over: [raw.sendall(long_frame(1000, bytes(500))), over.wait()],
        "sends what nobody asked for": for_ever(unasked * 1000),
        "sends frames of one message without end": lambda raw, over: [
            (raw.sendall(b"\x01\x00" * 1000), time.sleep(0.01)) for _ in iter(over.is_set, True)
        ],
        "sends a frame that is too large": lambda raw, over: [raw.sendall(long_frame(1 << 40)), over.wait()],
    }


@pytest.mark.parametrize("behaviour", native_slow())
def test_an_act_ends_in_time_at_a_native_server_that(behaviour):
    with native(native_slow()[behaviour]) as port, vla_cpp.Client(f"tcp://127.0.0.1:{port}", timeout=30) as policy:
        start = time.monotonic()
        with pytest.raises((vla_cpp.Timeout, vla_cpp.Disconnected, vla_cpp.Incompatible)):
            policy.act(images={}, state=[0], text="go", timeout=TIMEOUT)
        assert time.monotonic() - start < TIMEOUT + SLACK


# --- vla replay ----------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def recording(case, tmp_path_factory):
    folder = tmp_path_factory.mktemp("recording") / "folder"
    server = Server(case, "--record", str(folder))
    with Robot(server.address, case) as robot:
        robot.acts(2)
    assert server.stop() == 0
    return folder


def refusal(where):
    return lambda request: [response(request, error=wire.MESSAGES["Error"](code=14, where=where, expected=where, found=where, hint=where))]


@pytest.mark.parametrize(
    "on_act, code, told",
    [
        (refusal(ESCAPES), 10, "owned"),
        (refusal("x" * 3_000_000), 10, "answers differ"),
        (lambda request: [bytes(17 << 20)], 9, "the server ended the connection"),
        (lambda request: [b"no response"], 9, "bytes that are none"),
        (lambda request: [response(request, chunk=chunk(float("nan")))], 10, "answers differ"),
    ],
    ids=["escapes", "long", "large", "bytes", "nan"],
)
def test_a_replay_takes_no_more_from_a_server_than_it_shows(recording, faulty, on_act, code, told):
    faulty.on_act = on_act
    command = [VLA, "replay", recording, "--connect", faulty.address]
    ran = subprocess.run(list(map(str, command)), capture_output=True, text=True, timeout=3 * SECONDS)
    assert ran.returncode == code and told in ran.stdout + ran.stderr, ran
    assert all(line.isprintable() for line in (ran.stdout + ran.stderr).split("\n")) and len(ran.stdout + ran.stderr) < 100_000


def test_a_replay_is_told_of_a_server_that_describes_nothing(recording, faulty):
    faulty._answers = lambda request: [response(request, error=wire.MESSAGES["Error"](code=14))]
    ran = subprocess.run([str(VLA), "replay", str(recording), "--connect", faulty.address], capture_output=True, text=True, timeout=SECONDS)
    assert ran.returncode == 9 and "a description of its policy" in ran.stderr

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The client against a server that misbehaves, and against none."""

import os
import pickle
import re
import socket
import threading
import time

import numpy as np
import pytest
import zmq
from faulty_server import chunk, response

import vla_cpp
from vla_cpp import wire
from vla_cpp.client import _health
from vla_cpp.control import ChunkLoop

FRAME = np.zeros((64, 64, 3), np.uint8)
OBSERVATION = {"images": {"top": FRAME}, "state": [0.0, 0.0], "text": "go"}


@pytest.fixture
def client(faulty):
    with vla_cpp.Client(faulty.address, timeout=2) as client:
        yield client


def error_message(code, **fields):
    number = wire.MESSAGES["Error"].DESCRIPTOR.enum_types_by_name["Code"].values_by_name[code].number
    return wire.MESSAGES["Error"](code=number, **fields)


def test_a_chunk_is_an_array_of_float32_with_its_facts(faulty, client):
    got = client.act(**OBSERVATION, seed=7, capture_time_ns=5)
    assert np.asarray(got).dtype == np.float32 and np.asarray(got).shape == (4, 2)
    assert (np.asarray(got) == 7).all()
    assert got.bundle.checksum == "xxh3:1"
    assert faulty.acts[0].act.capture_time_ns == 5


def test_the_first_thing_sent_is_a_hello_and_the_description_is_asked_for_once(faulty, client):
    client.act(**OBSERVATION)
    client.act(**OBSERVATION)
    assert faulty.kinds == ["hello", "describe", "act", "act"]


def test_the_timeout_is_the_deadline_unless_another_is_given(faulty, client):
    client.act(**OBSERVATION)
    client.act(**OBSERVATION, deadline_ms=30)
    assert [a.act.deadline_ms for a in faulty.acts] == [2000, 30]


def test_a_late_answer_is_never_taken_for_the_answer_to_another_request(faulty, client):
    kept = []

    def crossed(request):
        kept.append(request)
        if len(kept) == 1:
            return []
        return [response(r, chunk=chunk(r.act.seed)) for r in kept]  # the one of the first request goes out first

    faulty.on_act = crossed
    with pytest.raises(vla_cpp.Timeout):
        client.act(**OBSERVATION, seed=1, timeout=0.2)
    assert client.act(**OBSERVATION, seed=2)[0, 0] == 2


def test_answers_that_come_in_another_order_reach_those_who_asked(faulty, client):
    kept = []

    def reversed_pairs(request):
        kept.append(request)
        return [response(r, chunk=chunk(r.act.seed)) for r in reversed(kept)] if len(kept) == 2 else []

    faulty.on_act = reversed_pairs
    first, second = client.submit(**OBSERVATION, seed=1), client.submit(**OBSERVATION, seed=2)
    assert first.result()[0, 0] == 1 and second.result()[0, 0] == 2


def test_silence_ends_with_a_timeout_and_the_next_call_has_a_fresh_socket(faulty, client):
    faulty.on_act = lambda request: []
    start = time.monotonic()
    with pytest.raises(vla_cpp.Timeout) as caught:
        client.act(**OBSERVATION, timeout=0.3)
    assert 0.3 <= time.monotonic() - start < 5
    assert caught.value.where == faulty.address and "0.3 s" in str(caught.value)
    client.health()
    assert len(faulty.peers) == 2 and faulty.kinds[-3:] == ["hello", "describe", "health"]


def test_a_timeout_of_one_request_leaves_another_under_way(faulty, client):
    kept = []
    faulty.on_act = lambda request: (
        kept.append(request)
        or ([] if len(kept) < 3 else [response(kept[0], chunk=chunk(1)), response(request, chunk=chunk(3))])
    )
    first, second = client.submit(**OBSERVATION, seed=1), client.submit(**OBSERVATION, seed=2, timeout=0.1)
    with pytest.raises(vla_cpp.Timeout):
        second.result()
    assert client.act(**OBSERVATION, seed=3)[0, 0] == 3
    assert first.result()[0, 0] == 1 and len(faulty.peers) == 1


def test_no_server_is_a_timeout_and_a_server_that_comes_later_is_found():
    with socket.create_server(("127.0.0.1", 0)) as probe:  # gone at once when closed, as a socket of ZeroMQ is not
        port = probe.getsockname()[1]
    with vla_cpp.Client(f"tcp://127.0.0.1:{port}", timeout=0.2) as client:
        with pytest.raises(vla_cpp.Timeout):
            client.health()
        with zmq.Context.instance().socket(zmq.ROUTER) as server:
            server.bind(f"tcp://127.0.0.1:{port}")
            assert not client._ask("health", 5.0, _health).done()
            assert server.poll(5000), "the request reaches the server that was started after the client"


@pytest.mark.parametrize("code", list(wire.MESSAGES["Error"].DESCRIPTOR.enum_types_by_name["Code"].values_by_name))
def test_each_code_is_an_exception_that_carries_its_fields(faulty, client, code):
    told = error_message(code, where="w", expected="e", found="f", hint="h")
    faulty.on_act = lambda request: [response(request, error=told)]
    with pytest.raises(vla_cpp.VlaError) as caught:
        client.act(**OBSERVATION)
    error = caught.value
    assert (error.code, error.where, error.expected, error.found, error.hint) == (code.lower(), "w", "e", "f", "h")
    if code not in ("CODE_UNSPECIFIED", "MISMATCH"):  # never sent
        assert type(error) is not vla_cpp.VlaError
    copy = pickle.loads(pickle.dumps(error))
    assert type(copy) is type(error) and str(copy) == str(error) and copy.code == error.code


def test_a_code_of_a_later_server_is_a_vla_error_that_tells_its_number(faulty, client):
    faulty.on_act = lambda request: [response(request, error=wire.MESSAGES["Error"](code=99, found="f"))]
    with pytest.raises(vla_cpp.VlaError) as caught:
        client.act(**OBSERVATION)
    assert caught.value.code == "code_99"


@pytest.mark.parametrize(
    "answer",
    [
        b"\xff\xff garbage",
        lambda r: wire.Response(protocol_version=2, request_id=r.request_id, chunk=chunk(0)),
        lambda r: response(r, health=wire.MESSAGES["HealthReply"]()),
        lambda r: response(r),
        lambda r: response(r, chunk=chunk(0, horizon=5)),
        lambda r: response(r, chunk=chunk(float("nan"))),
        lambda r: response(r, chunk=chunk(0, horizon=0, d_action=0)),
    ],
)
def test_an_answer_that_is_none_raises_and_the_next_request_is_served(faulty, client, answer):
    faulty.on_act = lambda request: [answer(request) if callable(answer) else answer]
    with pytest.raises((vla_cpp.Incompatible, vla_cpp.BadAction)):
        client.act(**OBSERVATION)
    faulty.on_act = lambda request: [response(request, chunk=chunk(3))]
    assert client.act(**OBSERVATION)[0, 0] == 3


def test_a_server_of_another_protocol_is_refused_by_the_hello(faulty):
    told = error_message("INCOMPATIBLE", where="hello", expected="2 to 3", found="1 to 1")
    faulty.on_hello = lambda request: [response(request, error=told)]
    faulty.on_act = lambda request: []
    with vla_cpp.Client(faulty.address, timeout=2) as client:
        with pytest.raises(vla_cpp.Incompatible, match="expected 2 to 3, found 1 to 1"):
            client.health()


def test_other_weights_behind_the_same_address_are_refused(faulty, client):
    client.act(**OBSERVATION)
    other = chunk(1)
    other.bundle.checksum = "xxh3:2"
    faulty.on_act = lambda request: [response(request, chunk=other)]
    with pytest.raises(vla_cpp.Incompatible, match="xxh3:2"):
        client.act(**OBSERVATION)


FALSE = {
    "shape of the answer: expected (4, 2), found (2, 4)": lambda c: (setattr(c, "horizon", 2), setattr(c, "d_action", 4)),
    "column names of the answer: expected ('a', 'b'), found ('b', 'a')": lambda c: c.names.reverse(),
    "column names of the answer: expected ('a', 'b'), found ('a',)": lambda c: c.names.pop(),
    "seed of the answer: expected 7, found 8": lambda c: setattr(c, "seed", 8),
    "capture time of the answer: expected 5, found 6": lambda c: setattr(c, "capture_time_ns", 6),
    "normalized rows of the answer: expected none, found (4, 2)": lambda c: c.normalized.extend([0.0] * 8),
}


@pytest.mark.parametrize("message", FALSE)
def test_a_chunk_that_does_not_go_with_the_request_and_the_description_is_refused(faulty, client, message):
    told = chunk(1)
    FALSE[message](told)
    faulty.on_act = lambda request: [response(request, chunk=told)]
    with pytest.raises(vla_cpp.Incompatible, match=re.escape(message)):
        client.act(**OBSERVATION, seed=7, capture_time_ns=5)
    faulty.on_act = lambda request: [response(request, chunk=chunk(3))]
    assert client.act(**OBSERVATION)[0, 0] == 3


def test_actions_that_no_robot_is_commanded_come_with_a_note_for_each_column(faulty, client):
    told = chunk(0.5)
    told.actions[3] = -2e6
    faulty.on_act = lambda request: [response(request, chunk=told)]
    assert client.act(**OBSERVATION).notes == ('action "b": 2e+06, beyond 1e+06, which no unit of a robot explains',)


def test_what_a_server_says_is_shown_without_what_a_terminal_obeys(faulty, client):
    hostile = "\x1b]0;owned\x07\x1b[2J\nerror: forged"
    told = chunk(1)
    told.notes.append(hostile)
    faulty.on_act = lambda request: [response(request, chunk=told)]
    assert client.act(**OBSERVATION).notes[0].isprintable()
    refused = error_message("BUSY", where=hostile, expected=hostile, found=hostile, hint=hostile)
    faulty.on_act = lambda request: [response(request, error=refused)]
    with pytest.raises(vla_cpp.Busy) as caught:
        client.act(**OBSERVATION)
    assert str(caught.value).isprintable() and "forged" in str(caught.value)


@pytest.mark.parametrize("mode", ["sync", "async"])
@pytest.mark.parametrize(
    "change",
    [
        lambda d: d.actions[0].MergeFrom(wire.MESSAGES["Dimension"](name="c")),
        lambda d: setattr(d, "horizon", 8),
        lambda d: setattr(d, "noise_kind", "uniform"),
        lambda d: setattr(d.bundle, "checksum", "xxh3:2"),
    ],
)
def test_a_server_that_comes_back_with_another_policy_is_an_error_of_a_loop(faulty, client, change, mode):
    with ChunkLoop(client, rate_hz=20, replan_every=1, mode=mode, blend="replace", on_late="hold", on_note="raise") as loop:
        loop.begin(OBSERVATION)
        change(faulty.description)
        client._drop(vla_cpp.Disconnected(faulty.address, "", "the server was started anew"))
        with pytest.raises(vla_cpp.Incompatible):
            for _ in range(40):
                loop.step(OBSERVATION)
                loop.pace()


def test_a_loop_tells_a_server_that_lists_it_who_drives_and_what_it_counts(faulty):
    def greet(*features):
        reply = wire.MESSAGES["HelloReply"](min_version=1, max_version=1, features=features)
        faulty.on_hello = lambda request: [response(request, hello=reply)]

    greet("leftover", "loop")
    options = dict(rate_hz=20, replan_every=1, mode="sync", blend="replace", on_late="hold", on_note="raise", max_jump=0.5)
    with vla_cpp.Client(faulty.address, timeout=2) as client, ChunkLoop(client, **options, clock=lambda: 0.0) as loop:
        for seed in (1, 3, 3):
            loop.step({**OBSERVATION, "seed": seed})
        loop.take_over("ana")
        loop.step(OBSERVATION, human=[0, 0])
        loop.step(OBSERVATION)
        told = [request.act.loop for request in faulty.acts]
        assert [(state.driver, state.actions, state.human, state.limited) for state in told] == [(1, 0, 0, 0), (1, 1, 0, 0), (1, 2, 0, 1), (2, 3, 0, 2), (2, 3, 1, 2)]
        assert client.features == {"leftover", "loop"}
        greet("leftover")  # one that is older takes its place
        client._drop(vla_cpp.Disconnected(faulty.address, "", "the server was started anew"))
        assert client.features == frozenset()
        loop.give_back("ana")
        loop.step(OBSERVATION)
        loop.step(OBSERVATION)
        assert not any(request.act.HasField("loop") for request in faulty.acts[-2:])


def test_a_server_that_comes_back_on_another_device_is_the_same_policy(faulty, client):
    client.act(**OBSERVATION)
    faulty.description.runtime.device, faulty.description.bundle.name = "cuda:0", "moved.gguf"
    client._drop(vla_cpp.Disconnected(faulty.address, "", "the server was started anew"))
    assert client.act(**OBSERVATION, seed=3)[0, 0] == 3


def test_an_error_that_names_no_request_ends_those_under_way(faulty, client):
    told = error_message("BAD_REQUEST", where="message", found="bytes")
    faulty.on_act = lambda request: [wire.Response(protocol_version=1, error=told)]
    with pytest.raises(vla_cpp.BadRequest):
        client.act(**OBSERVATION)


def test_what_the_server_would_not_read_is_refused_before_it_is_sent(faulty, client):
    with pytest.raises(vla_cpp.TooLarge, match=r"observation.images.top"):
        client.act(**{**OBSERVATION, "images": {"top": np.zeros((300, 300, 3), np.uint8)}})
    jpeg = b"\xff\xd8\xff" + bytes(2 << 20)
    with pytest.raises(vla_cpp.TooLarge, match="at most 1048576 bytes"):
        client.act(**{**OBSERVATION, "images": {"top": jpeg}})
    assert faulty.acts == []


def test_a_closed_client_refuses_and_says_so(faulty):
    client = vla_cpp.Client(faulty.address)
    faulty.on_act = lambda request: []
    pending = client.submit(**OBSERVATION)
    client.close()
    client.close()
    with pytest.raises(vla_cpp.Disconnected, match="closed"):
        pending.result()
    with pytest.raises(vla_cpp.Disconnected, match="closed"):
        client.act(**OBSERVATION)


def test_a_child_process_is_refused_and_the_parent_goes_on(faulty, client):
    client.act(**OBSERVATION)
    child = os.fork()
    if child == 0:
        try:
            client.health()
        except vla_cpp.UsageError:
            os._exit(7)
        os._exit(1)
    assert os.WEXITSTATUS(os.waitpid(child, 0)[1]) == 7
    assert client.health().ready
    with pytest.raises(vla_cpp.UsageError):
        pickle.dumps(client)


def test_threads_may_share_a_client_and_each_gets_its_own_answer(faulty, client):
    assert client.spec.horizon == 4
    wrong = []

    def work(seed):
        for _ in range(20):
            if client.act(**OBSERVATION, seed=seed)[0, 0] != seed:
                wrong.append(seed)

    threads = [threading.Thread(target=work, args=(seed,)) for seed in range(1, 7)]
    [t.start() for t in threads]
    [t.join() for t in threads]
    assert wrong == [] and len(faulty.acts) == 120


def test_submitting_never_waits_once_the_policy_is_known(faulty, client):
    assert client.spec.d_action == 2
    faulty.on_act = lambda request: []
    start = time.monotonic()
    pending = client.submit(**OBSERVATION, timeout=2)
    for _ in range(5):
        assert not pending.done()
    assert time.monotonic() - start < 1
    with pytest.raises(vla_cpp.Timeout):
        pending.result()
    assert pending.done()


@pytest.mark.parametrize("address", ["nonsense", "tcp://127.0.0.1", ""])
def test_an_impossible_address_is_refused_at_once(address):
    with pytest.raises(vla_cpp.UsageError):
        vla_cpp.Client(address)


@pytest.mark.parametrize("key", ["short", "x" * 39 + "\x7f", "é" * 40, "/nowhere/robot.secret", b"x" * 40, 7])
def test_keys_that_are_none_are_refused_at_once_and_not_shown(key):
    with pytest.raises(vla_cpp.UsageError) as caught:
        vla_cpp.Client("tcp://127.0.0.1:5555", server_key="x" * 40, secret_key=key)
    assert caught.value.where == "secret_key" and str(key) not in str(caught.value)


def test_one_key_alone_is_refused():
    with pytest.raises(vla_cpp.UsageError, match="server_key and secret_key"):
        vla_cpp.Client("tcp://127.0.0.1:5555", server_key="x" * 40)

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""`vla serve --openpi` beside what openpi-server 0.1.0 said to the same bytes: equal but for the words of errors."""

import json
from pathlib import Path

import pytest

pytest.importorskip("msgpack")

from drop_in import openpi_array, pack, serving, unpack  # noqa: E402
from hostile import UPGRADE, websocket_frame  # noqa: E402
from openpi_test import keys_of, observation, options  # noqa: E402, F401
from record_openpi_server import AFTER_GREETING, REQUESTS, after_greeting, request, split  # noqa: E402

RECORDED = json.loads((Path(__file__).parent / "data/openpi_server.json").read_text())


@pytest.fixture(scope="module")
def port(case, options):  # noqa: F811
    with serving(case, "--openpi", "127.0.0.1:0", *options) as (_, address):
        yield int(address("ws://").rsplit(":", 1)[1])


def fields(head, *names):
    """The status line, and those fields of a head of HTTP."""
    pairs = dict(line.lower().split(": ", 1) for line in head[1:])
    return head[0], {name: pairs.get(name) for name in names}


def test_health_is_the_same_answer(port):
    head, body = request(port, REQUESTS["health"])
    recorded = RECORDED["requests"]["health"]
    names = ("connection", "content-length", "content-type")
    assert fields(head, *names) == fields(recorded["head"], *names) and body == bytes.fromhex(recorded["rest"])


def test_any_path_is_upgraded_in_the_same_way(port):
    head, _ = request(port, REQUESTS["another path"])
    names = ("upgrade", "connection", "sec-websocket-accept", "sec-websocket-extensions", "sec-websocket-protocol")
    assert fields(head, *names) == fields(RECORDED["requests"]["another path"]["head"], *names)


def test_metadata_and_answers_are_packed_to_the_byte_as_the_reference_packs_them(case, port):
    reference = [RECORDED["greeting"], *RECORDED["answers"]]
    greeting = split(request(port, UPGRADE)[1])
    message = pack(observation(case, 7), openpi_array)
    answers = after_greeting(port, websocket_frame(0x82, message), websocket_frame(0x82, message))
    for data in [*map(bytes.fromhex, reference), greeting[0][1], *(payload for _, payload in answers)]:
        assert pack(unpack(data), openpi_array) == data
    assert [first for first, _ in (*greeting, *answers)] == [0x82] * 3
    ours, theirs = ([list(unpack(a)["server_timing"])[:2] for a in some] for some in (
        [payload for _, payload in answers], [bytes.fromhex(a) for a in RECORDED["answers"]]
    ))  # fmt: skip
    assert ours[0][0] == theirs[0][0] == "infer_ms" and ours[1] == theirs[1]
    for payload, recorded in zip(answers, RECORDED["answers"]):
        keys = list(unpack(bytes.fromhex(recorded)))
        assert [key for key in unpack(payload[1]) if key in keys] == keys


@pytest.mark.parametrize("name", AFTER_GREETING)
def test_every_other_message_is_answered_with_the_same_frames(port, name):
    ours = after_greeting(port, AFTER_GREETING[name])
    theirs = [(first, bytes.fromhex(payload)) for first, payload in RECORDED["after greeting"][name]]
    assert [first for first, _ in ours] == [first for first, _ in theirs]
    for (first, payload), (_, recorded) in zip(ours, theirs):
        if first == 0x81:  # the words of an error
            assert payload and payload.decode().isprintable()
        elif first == 0x88 and recorded[:2] in (b"\x03\xea", b"\x03\xef"):  # and of a fault in the framing
            assert payload[:2] == recorded[:2]
        elif name.startswith("a close with"):  # Beast's echo has the code alone, and 1000 where there was none
            assert payload == b"\x03\xe8"
        else:
            assert payload == recorded


def test_a_message_in_pieces_with_a_ping_between_is_one_message(case, port):
    message = pack(observation(case, 7), openpi_array)
    at = len(message) // 2
    pieces = [(0x02, message[:at]), (0x89, b"?"), (0x80, message[at:]), (0x82, message)]
    came = after_greeting(port, *(websocket_frame(*piece) for piece in pieces))
    assert came[0] == (0x8A, b"?")
    chunks = [unpack(payload)["actions"].tobytes() for first, payload in came[1:]]
    assert len(chunks) == 2 and chunks[0] == chunks[1]

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""openpi's protocol as `vla serve --openpi` speaks it: chunks, errors and ends as its clients expect them."""

import json
import socket
import statistics
import subprocess
import threading
import time
import urllib.error
import urllib.request

import numpy as np
import pytest

pytest.importorskip("msgpack")

from drop_in import WebSocket, numpy_array, openpi_array, pack, serving, unpack  # noqa: E402
from server_process import SECONDS, VLA, frames, ran  # noqa: E402

import vla_cpp  # noqa: E402


def keys_of(case):
    """A key of a client for each view of the case."""
    return {f"observation/{view.rsplit('.')[-1]}": view for view in frames(case)}


@pytest.fixture(scope="module")
def options(case):
    lines = [f"{key}={view}" for key, view in keys_of(case).items()]
    return [a for line in [*lines, "observation/state=observation.state"] for a in ("--map", line)]


@pytest.fixture(scope="module")
def served(case, options):
    with serving(case, "--openpi", "127.0.0.1:0", "--max-message", "1", *options) as (line, address):
        yield line, address("ws://"), address("tcp://")


@pytest.fixture
def client(served):
    with WebSocket(served[1]) as client:
        client.metadata = unpack(client.receive()[1])
        yield client


def observation(case, seed=None):
    images = {key: frames(case)[view] for key, view in keys_of(case).items()}
    rest = {} if seed is None else {"vla": {"seed": seed}}
    return {**images, "observation/state": np.array(case.state, np.float32), "prompt": case.text, **rest}


def test_a_chunk_is_the_one_of_vla_run_bit_for_bit_in_every_layout_of_arrays(case, client, tmp_path):
    expected = ran(case, tmp_path, "--seed", "7")
    assert client.metadata["action_horizon"] == expected.shape[0]
    for array in (openpi_array, numpy_array, lambda a: openpi_array(a, str)):
        answer = client.ask(pack(observation(case, 7), array))
        assert answer["actions"].dtype == np.float32
        assert answer["actions"].tobytes() == expected.tobytes() and answer["actions"].shape == expected.shape
    timing = answer["server_timing"]
    assert all(isinstance(value, float) for value in {**timing, **answer["policy_timing"]}.values())
    assert 0 < answer["policy_timing"]["infer_ms"] <= timing["infer_ms"] <= timing["prev_total_ms"] * 100


def test_an_empty_prompt_is_an_instruction(case, client, tmp_path):
    answer = client.ask(pack({**observation(case, 7), "prompt": ""}, openpi_array))
    assert answer["actions"].tobytes() == ran(case, tmp_path, "--seed", "7", text="").tobytes()
    assert "instruction: empty" in answer["notes"]


def test_planes_and_floats_are_the_same_image(case, client):
    sound = observation(case, 3)
    expected = client.ask(pack(sound, openpi_array))["actions"].tobytes()
    planes = {k: np.ascontiguousarray(v.transpose(2, 0, 1)) if np.ndim(v) == 3 else v for k, v in sound.items()}
    assert client.ask(pack(planes, openpi_array))["actions"].tobytes() == expected


def test_a_message_over_the_limit_ends_with_code_1009_which_the_client_can_read(served):
    for _ in range(8):  # a race where the rest of the message is not read
        with WebSocket(served[1]) as client:
            client.receive()
            client.send(bytes(24 << 20))
            opcode, end = client.receive()
            assert opcode == 8 and end[:2] == (1009).to_bytes(2, "big")


def test_without_a_seed_chunks_differ_and_tell_theirs(case, client):
    first, second = (client.ask(pack(observation(case), openpi_array)) for _ in range(2))
    assert first["actions"].tobytes() != second["actions"].tobytes()
    again = client.ask(pack(observation(case, first["seed"] & (1 << 63) - 1), openpi_array))
    assert first["seed"] >= 0 and again["actions"].tobytes() == first["actions"].tobytes()


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda o: o.pop("prompt"), "prompt"),
        (lambda o: o.update({"camera": o["observation/state"]}), "camera"),
        (lambda o: o.update({"observation/state": np.zeros(99, np.float32)}), "observation.state"),
        (lambda o: o.update({"observation/state": np.full(6, np.nan, np.float32)}), "observation.state"),
        (lambda o: o.update({"vla": {"deadline_ms": 0}}), "deadline_ms"),
        (lambda o: o.update({"vla": {"sede": 1}}), "sede"),
    ],
)
def test_an_error_is_a_text_frame_and_the_end_with_code_1011(case, client, change, words):
    wrong = observation(case, 1)
    change(wrong)
    client.send(pack(wrong, openpi_array))
    opcode, text = client.receive()
    assert opcode == 1 and text.startswith(b"bad_observation: ") and words.encode() in text
    opcode, end = client.receive()
    assert opcode == 8 and end == b"\x03\xf3Internal server error. Traceback included in previous frame."


@pytest.mark.parametrize("payload", [b"", b"\xc1", b"\x81", b"\xdd\xff\xff\xff\xff", b"\x91" * 900, b"text"])
def test_bytes_that_are_no_message_end_the_connection_in_the_same_way(case, served, payload):
    with WebSocket(served[1]) as client:
        client.receive()
        client.send(payload)
        assert client.receive()[0] == 1 and client.receive()[0] == 8
    with WebSocket(served[1]) as client:
        client.receive()
        assert client.ask(pack(observation(case, 1), openpi_array))["actions"].size


def test_a_message_beyond_the_limit_ends_the_connection_with_code_1009(served):
    with WebSocket(served[1]) as client:
        client.receive()
        try:
            client.send(bytes(2 << 20))
            assert client.receive() in ((8, b"\x03\xf1"), None)
        except ConnectionError:  # it was still sending
            pass


def test_health_is_told_without_an_upgrade_and_everything_else_is_refused(served):
    url = served[1].replace("ws://", "http://")
    with urllib.request.urlopen(url + "/healthz", timeout=SECONDS) as answer:
        assert (answer.status, answer.read()) == (200, b"OK\n")
    with pytest.raises(urllib.error.HTTPError, match="426"):
        urllib.request.urlopen(url + "/", timeout=SECONDS)
    assert WebSocket(served[1], headers=["Origin: http://example.com"]).status == 403  # a page in a browser
    assert WebSocket(served[1], path="/v1/any").status == 101


def test_pings_are_answered_while_a_request_is_in_work_and_the_next_one_waits_its_turn(case, client):
    expected = client.ask(pack(observation(case, 1), openpi_array))["actions"].tobytes()
    message = pack(observation(case, 1), openpi_array)
    client.send(message)
    client.send(b"here?", opcode=9)
    client.send(message)
    answers = [client.receive() for _ in range(3)]
    assert (10, b"here?") in answers
    assert [unpack(data)["actions"].tobytes() for opcode, data in answers if opcode == 2] == [expected] * 2


def test_slow_and_dead_peers_hold_nobody_up(case, served):
    """They begin a message, a handshake or nothing, read no answers, and leave: the others' times stay what they were."""
    message = pack(observation(case, 1), openpi_array)
    with WebSocket(served[1]) as robot, vla_cpp.Client(served[2], timeout=SECONDS) as native:
        robot.receive()

        def p95(ask):
            seconds = []
            for _ in range(30):
                start = time.perf_counter()
                ask()
                seconds.append(time.perf_counter() - start)
            return statistics.quantiles(seconds, n=20)[-1]

        asks = [
            lambda: robot.ask(message),
            lambda: native.act(images=frames(case), state=case.state, text=case.text, seed=1),
        ]
        quiet = [p95(ask) for ask in asks]
        host, port = served[1].removeprefix("ws://").split(":")
        silent = [socket.create_connection((host, int(port))) for _ in range(20)]
        slow = [WebSocket(served[1]) for _ in range(10)]
        for peer in slow:
            peer.socket.sendall(b"\x82\xff" + (900_000).to_bytes(8, "big") + bytes(1000))
        for peer in silent[:10]:
            peer.sendall(b"GET / HT")
        stop = threading.Event()

        def leave():
            while not stop.wait(0.01):
                with WebSocket(served[1]) as peer:
                    peer.send(message)

        leaving = threading.Thread(target=leave)
        leaving.start()
        try:
            crowded = [p95(ask) for ask in asks]
        finally:
            stop.set()
            leaving.join()
        for peer in [*silent, *(peer for peer in slow)]:
            peer.close()
    assert all(after < 4 * before + 0.25 for before, after in zip(quiet, crowded)), (quiet, crowded)


def test_a_key_that_the_server_asks_for_is_asked_of_everybody(case, options, tmp_path):
    token = tmp_path / "token"
    token.write_text("s3cret\n")
    token.chmod(0o600)
    with serving(case, "--openpi", "127.0.0.1:0", "--api-token", token, *options) as (_, address):
        assert WebSocket(address("ws://")).status == 401
        assert WebSocket(address("ws://"), headers=["Authorization: Api-Key s3cre"]).status == 401
        with WebSocket(address("ws://"), headers=["Authorization: Api-Key s3cret"]) as client:
            assert client.status == 101 and client.receive()[0] == 2


def test_the_dialect_of_vllm_omni_keeps_the_connection_and_answers_with_the_actions_alone(case, options, tmp_path):
    """As its clients put it (vllm_omni/entrypoints/openpi/connection.py): errors and resets are binary maps."""
    expected = ran(case, tmp_path, "--seed", "7")
    extra = {"endpoint": "infer", "session_id": "episode 1", "seed": 7, "sampling_params": {}}
    asked = pack({**observation(case), **extra}, openpi_array)
    with serving(case, "--openpi", "127.0.0.1:0", "--vllm-omni", *options) as (_, address):
        with WebSocket(address("ws://"), path="/v1/realtime/robot/openpi") as client:
            metadata = unpack(client.receive()[1])
            assert (metadata["action_horizon"], metadata["action_dim"]) == expected.shape
            for _ in range(2):
                assert client.ask(asked).tobytes() == expected.tobytes()
                assert client.ask(pack({"endpoint": "reset"}, openpi_array)) == {"status": "reset successful"}
            for wrong, words in [
                ({"endpoint": "train"}, "infer or reset"),
                ({"sampling_params": {"num_inference_steps": 4}}, "sampling_params"),
                ({"seed": "7"}, "seed"),
                ({"prompt": 5}, "prompt"),
            ]:
                answer = client.ask(pack({**observation(case), **wrong}, openpi_array))
                assert answer["type"] == "error" and words in answer["message"], answer
            assert client.ask(b"\xc1")["type"] == "error"
            assert client.ask(asked).tobytes() == expected.tobytes()


def test_names_are_checked_at_the_start_and_told_in_the_ready_line(case, served, options):
    assert "names='" in served[0] and "(rgb)" in served[0] and "(radians)" in served[0]
    def refusal(*arguments, address="127.0.0.1:0"):
        command = [VLA, "serve", case.bundle, "--bind", "tcp://127.0.0.1:0", "--openpi", address, *arguments]
        ended = subprocess.run(list(map(str, command)), capture_output=True, text=True, timeout=60)
        assert ended.returncode == 2 and not ended.stdout
        return ended.stderr

    for view in frames(case):
        assert view in refusal()
    assert "observation/state" in refusal(*options[2:])
    assert "libero, droid, aloha" in refusal("--preset", "humanoid")
    assert "insecure" in refusal(*options, address="0.0.0.0:0")


def test_what_an_openpi_client_asked_can_be_replayed(case, options, tmp_path):
    with serving(case, "--openpi", "127.0.0.1:0", "--record", tmp_path / "kept", *options) as (_, address):
        with WebSocket(address("ws://")) as client:
            client.receive()
            client.ask(pack(observation(case), openpi_array))
    replayed = subprocess.run([VLA, "replay", tmp_path / "kept", "--bundle", case.bundle], capture_output=True, text=True)
    assert replayed.returncode == 0 and "1 " in replayed.stdout, replayed.stdout + replayed.stderr


def test_the_client_of_the_package_as_it_is(case, served, tmp_path):
    websocket_client_policy = pytest.importorskip("openpi_client.websocket_client_policy")
    from openpi_client.action_chunk_broker import ActionChunkBroker

    host, port = served[1].removeprefix("ws://").split(":")
    policy = websocket_client_policy.WebsocketClientPolicy(host, int(port))
    assert json.dumps(policy.get_server_metadata())
    expected = ran(case, tmp_path, "--seed", "7")
    assert policy.infer(observation(case, 7))["actions"].tobytes() == expected.tobytes()
    broker = ActionChunkBroker(policy, expected.shape[0])
    steps = [broker.infer(observation(case, 7))["actions"] for _ in range(expected.shape[0])]
    assert np.stack(steps).tobytes() == expected.tobytes()
    with pytest.raises(RuntimeError, match="bad_observation"):
        policy.infer({"prompt": case.text})

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The protocol of Isaac-GR00T's policy server as `vla serve --gr00t` speaks it, to the clients of its three releases."""

import json
import subprocess

import numpy as np
import pytest

pytest.importorskip("msgpack")

import msgpack  # noqa: E402
import zmq  # noqa: E402
from drop_in import npy_array, numpy_array, pack, serving, unpack  # noqa: E402
from golden_cases import Golden  # noqa: E402
from server_process import SECONDS, VLA, frames, ran  # noqa: E402

CASES = {"n1_5": "gr00t_n1_5/arms", "n1_6": "gr00t_n1_6/aspect", "n1_7": "gr00t_n1_7/clean_text"}


class Client:
    def __init__(self, address, array):
        self.socket = zmq.Context.instance().socket(zmq.REQ)
        self.socket.setsockopt(zmq.LINGER, 0)
        self.socket.setsockopt(zmq.RCVTIMEO, SECONDS * 1000)
        self.socket.connect(address.removeprefix("gr00t+"))
        self.array = array

    def send(self, *frames):
        self.socket.send_multipart(frames)
        return unpack(self.socket.recv())

    def ask(self, endpoint=None, data=None, **more):
        request = {**({"endpoint": endpoint} if endpoint else {}), **({"data": data} if data else {}), **more}
        return self.send(pack(request, self.array))


@pytest.fixture(scope="module", params=CASES)
def release(request):
    return request.param


@pytest.fixture(scope="module")
def robot(release):
    return Golden(CASES[release])


@pytest.fixture(scope="module")
def served(robot):
    with serving(robot, "--gr00t", "127.0.0.1:0") as (line, address):
        yield line, address("gr00t+")


def short(name):
    return name.rsplit(".", 1)[-1]


def states(case):
    state = case.state if isinstance(case.state, dict) else {"state": case.state}
    return {short(name): np.array(values, np.float32) for name, values in state.items()}


def nested(case):
    return {
        "video": {short(view): frame[None, None] for view, frame in frames(case).items()},
        "state": {name: values[None, None] for name, values in states(case).items()},
        "language": {"annotation.human.task_description": [[case.text]]},
    }


def flat(case, lead):
    return {
        **{f"video.{short(view)}": frame[(None,) * lead] for view, frame in frames(case).items()},
        **{f"state.{name}": values[(None,) * lead] for name, values in states(case).items()},
        "annotation.human.action.task_description": [case.text],
    }


def joined(actions):
    return np.concatenate(list(actions.values()), axis=-1)


def test_every_release_of_the_client_gets_the_chunk_of_vla_run(robot, served, tmp_path):
    expected = ran(robot, tmp_path, "--seed", "7")
    options = {"seed": 7}
    for array in (npy_array, numpy_array):
        client = Client(served[1], array)
        answer, info = client.ask("get_action", {"observation": nested(robot), "options": options})
        assert info == {} and joined(answer)[0].tobytes() == expected.tobytes()
        assert all(value.dtype == np.float32 and value.ndim == 3 for value in answer.values())
        answer, _ = client.ask(data={"observation": flat(robot, 2), "options": options})
        assert set(answer) == {f"action.{key}" for key in client.ask("get_modality_config")["action"]["as_json"]["modality_keys"]}
        assert joined(answer)[0].tobytes() == expected.tobytes()


def test_an_empty_instruction_is_one(robot, served, tmp_path):
    empty = {**nested(robot), "language": {"annotation.human.task_description": [[""]]}}
    answer, _ = Client(served[1], npy_array).ask("get_action", {"observation": empty, "options": {"seed": 7}})
    assert joined(answer)[0].tobytes() == ran(robot, tmp_path, "--seed", "7", text="").tobytes()


def test_the_first_release_sends_the_observation_itself_and_gets_its_actions_without_a_batch(robot, served):
    client = Client(served[1], npy_array)
    answer = client.ask("get_action", flat(robot, 1))
    assert all(key.startswith("action.") and value.ndim == 2 for key, value in answer.items())
    assert all(value.ndim == 3 for value in client.ask("get_action", flat(robot, 2)).values())
    config = client.ask("get_modality_config")
    assert config["video"]["__ModalityConfig_class__"] is True
    assert json.loads(config["state"]["as_json"])["modality_keys"] == [f"state.{name}" for name in states(robot)]
    assert len(json.loads(config["action"]["as_json"])["delta_indices"]) == next(iter(answer.values())).shape[0]


def test_a_modality_can_be_asked_for_before_anything_else(robot):
    for flags in ((), ("--gr00t-n1-5",)):
        with serving(robot, "--gr00t", "127.0.0.1:0", *flags) as (_, address):
            video = Client(address("gr00t+"), npy_array).ask("get_modality_config")["video"]
            assert video["__ModalityConfig_class__"] is True
            assert isinstance(video["as_json"], str) == bool(flags) and ("__ModalityConfig__" in video) != bool(flags)


def test_what_has_no_arrays_is_answered_in_the_words_of_the_reference(served):
    client = Client(served[1], npy_array)
    assert client.ask("ping") == {"status": "ok", "message": "Server is running"}
    assert client.ask("reset", {"options": None}) == {}
    assert client.ask("nothing") == {"error": "Unknown endpoint: nothing"}
    assert "--gr00t-kill" in client.ask("kill")["error"]
    assert client.ask("ping")["status"] == "ok"


@pytest.mark.parametrize(
    "frames_sent",
    [[b""], [b"\xc1"], [b"\x80\x80"], [b"\xdd\xff\xff\xff\xff"], [b"a", b"b"], [bytes(33 << 20)], [b"\x81\xa4data\xc0"]],
)
def test_every_message_is_answered(robot, served, frames_sent):
    client = Client(served[1], npy_array)
    assert "error" in client.send(*frames_sent)
    assert client.ask("ping")["status"] == "ok"


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda o: o.pop("state"), "state"),
        (lambda o: o.update(language={}), "instruction"),
        (lambda o: o.update(language={"a": [["x"]], "b": [["y"]]}), "two"),
        (lambda o: o["video"].update(other=next(iter(o["video"].values()))), "video.other"),
        (lambda o: o["video"].update({k: v.repeat(2, 0) for k, v in o["video"].items()}), "one observation"),
        (lambda o: o["state"].update({k: v.repeat(2, 1) for k, v in o["state"].items()}), "one time step"),
        (lambda o: o["video"].update({k: v.astype(np.int64) for k, v in o["video"].items()}), "uint8"),
        (lambda o: o["state"].update({k: v * np.nan for k, v in o["state"].items()}), "state"),
    ],
)
def test_an_observation_that_is_none_is_refused_by_name(robot, served, change, words):
    wrong = nested(robot)
    change(wrong)
    error = Client(served[1], numpy_array).ask("get_action", {"observation": wrong, "options": None})["error"]
    assert error.startswith("bad_observation: ") and words in error


def test_a_token_is_asked_of_everybody_and_kill_only_works_where_it_was_asked_for(tmp_path):
    case = Golden(CASES["n1_7"])
    token = tmp_path / "token"
    token.write_text("s3cret\n")
    token.chmod(0o600)
    options = ("--gr00t", "127.0.0.1:0", "--api-token", token, "--gr00t-kill")
    with serving(case, *options, stops=True) as (_, address):
        client = Client(address("gr00t+"), numpy_array)
        assert client.ask("ping") == {"error": "Unauthorized: Invalid API token"}
        assert client.ask("kill", api_token="s3cre") == {"error": "Unauthorized: Invalid API token"}
        assert client.ask("ping", api_token="s3cret")["status"] == "ok"
        assert client.ask("kill", api_token="s3cret") is None


def test_a_line_gives_a_feature_another_key(robot, served, tmp_path):
    view = next(iter(frames(robot)))
    expected = ran(robot, tmp_path, "--seed", "7")
    assert f"video.{short(view)}={short(view)}(rgb)" in served[0]
    with serving(robot, "--gr00t", "127.0.0.1:0", "--map", f"video.webcam={view},bgr") as (_, address):
        observation = nested(robot)
        observation["video"]["webcam"] = observation["video"].pop(short(view))[..., ::-1].copy()
        client = Client(address("gr00t+"), numpy_array)
        answer, _ = client.ask("get_action", {"observation": observation, "options": {"seed": 7}})
        assert joined(answer)[0].tobytes() == expected.tobytes()


def test_a_bundle_for_several_robots_and_an_address_that_others_reach_are_refused(served, robot):
    command = [VLA, "serve", robot.bundle, "--bind", "tcp://127.0.0.1:0", "--gr00t", "0.0.0.0:0"]
    ended = subprocess.run(list(map(str, command)), capture_output=True, text=True, timeout=60)
    assert ended.returncode == 2 and "--insecure" in ended.stderr

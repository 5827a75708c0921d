# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""A robot with fewer cameras than the policy lists: --absent, of every protocol, gives the chunk of a view that `vla run` declares absent."""

import subprocess

import numpy as np
import pytest

pytest.importorskip("msgpack")

from drop_in import WebSocket, numpy_array, openpi_array, pack, serving, unpack  # noqa: E402
from golden_cases import Golden  # noqa: E402
from server_process import SECONDS, VLA, frames, ran  # noqa: E402

import vla_cpp  # noqa: E402

ABSENT = "front"
PRESENT = ("wrist", "base")


@pytest.fixture(scope="module")
def case():
    return Golden("absent_view")


@pytest.fixture
def expected(case, tmp_path):
    return ran(case, tmp_path, "--seed", "7")


def images(case):
    return {view: frame for view, frame in frames(case).items() if frame is not None}


def refused(*arguments):
    done = subprocess.run([VLA, *map(str, arguments)], capture_output=True, text=True, timeout=SECONDS)
    assert done.returncode == 2 and done.stdout == "", done
    return done.stderr


def openpi_options(*more):
    lines = [f"observation/{view}={view}" for view in PRESENT] + ["observation/state=observation.state"]
    return ["--openpi", "127.0.0.1:0", *(a for line in lines for a in ("--map", line)), *more]


def test_openpi_gets_the_chunk_and_is_told_at_the_start_what_is_missing(case, expected):
    words = refused("serve", case.bundle, "--bind", "tcp://127.0.0.1:0", *openpi_options())
    assert "observation.images.front" in words and "--absent VIEW" in words
    with serving(case, *openpi_options("--absent", ABSENT)) as (line, address), WebSocket(address("ws://")) as client:
        assert "front(absent)" in line
        client.receive()
        message = {f"observation/{view}": frame for view, frame in images(case).items()}
        message |= {"observation/state": np.array(case.state, np.float32), "prompt": case.text, "vla": {"seed": 7}}
        assert client.ask(pack(message, openpi_array))["actions"].tobytes() == expected.tobytes()


def test_groot_gets_the_chunk_and_a_frame_of_the_view_is_refused(case, expected):
    import zmq

    with serving(case, "--gr00t", "127.0.0.1:0", "--absent", ABSENT) as (_, address):
        with zmq.Context() as context, context.socket(zmq.REQ) as client:
            client.setsockopt(zmq.RCVTIMEO, SECONDS * 1000)
            client.setsockopt(zmq.REQ_CORRELATE, 1)
            client.setsockopt(zmq.LINGER, 0)
            client.connect(address("gr00t+").removeprefix("gr00t+"))

            def ask(seen):
                video = {view: frame[None, None] for view, frame in seen.items()}
                state = {"state": np.array(case.state, np.float32)[None, None]}
                observation = {"video": video, "state": state, "language": {"task": [[case.text]]}}
                request = {"endpoint": "get_action", "data": {"observation": observation, "options": {"seed": 7}}}
                client.send(pack(request, numpy_array))
                return unpack(client.recv())

            actions, _ = ask(images(case))
            assert np.concatenate(list(actions.values()), axis=-1)[0].tobytes() == expected.tobytes()
            assert "video.front" in ask({**images(case), "front": images(case)["base"]})["error"]


def test_a_robot_of_lerobot_without_a_camera_is_refused_before_it_moves_unless_it_was_said(case):
    grpc = pytest.importorskip("grpc")
    from lerobot_calls import Robot
    from lerobot_pickles import TimedObservation, setup_of

    if "libgrpc++" in subprocess.run([VLA, "serve", case.bundle, "--bind", "tcp://127.0.0.1:0", "--lerobot", "here"], capture_output=True, text=True).stderr:
        pytest.skip("a build without libgrpc++")
    motors = [f"joint_{i}.pos" for i in range(len(case.state))]
    with serving(case, "--lerobot", "127.0.0.1:0") as (_, address), Robot(address("grpc://")) as robot:
        with pytest.raises(grpc.RpcError) as raised:
            robot.begin(setup_of(motors, images(case)))
        assert "front" in raised.value.details() and "--absent" in raised.value.details()
    with serving(case, "--lerobot", "127.0.0.1:0", "--absent", ABSENT) as (_, address), Robot(address("grpc://")) as robot:
        robot.begin(setup_of(motors, images(case)))
        readings = dict(zip(motors, map(float, case.state)))
        robot.observe(TimedObservation(1.0, 0, {**readings, **images(case), "task": case.text}, True))
        assert robot.actions()


def test_a_client_of_vla_need_not_mention_it(case, expected, tmp_path):
    rest = {"state": case.state, "text": case.text, "seed": 7}
    with serving(case, "--absent", ABSENT, "--record", tmp_path / "kept") as (_, address), vla_cpp.Client(address("tcp://"), timeout=SECONDS) as client:
        assert client.act(images=images(case), **rest).actions.tobytes() == expected.tobytes()
        with pytest.raises(vla_cpp.BadObservation, match="declared absent"):
            client.act(images={**images(case), ABSENT: images(case)["base"]}, **rest)
    replay = [VLA, "replay", tmp_path / "kept", "--bundle", case.bundle, "--absent", ABSENT]
    done = subprocess.run(replay, capture_output=True, text=True, timeout=SECONDS)
    assert done.returncode == 0 and " answers the same, 0 different" in done.stdout, done


@pytest.mark.parametrize("kind", ["client", "policy"])
def test_python_says_it_once(case, expected, kind):
    with serving(case) as (_, address):
        make = (lambda **more: vla_cpp.Client(address("tcp://"), timeout=SECONDS, **more)) if kind == "client" else (
            lambda **more: vla_cpp.Policy(case.bundle, threads=1, **more))  # fmt: skip
        rest = {"state": case.state, "text": case.text, "seed": 7}
        with make(absent=[ABSENT]) as policy:
            assert policy.act(images=images(case), **rest).actions.tobytes() == expected.tobytes()
            with pytest.raises(vla_cpp.BadObservation, match="declared absent"):
                policy.act(images={**images(case), ABSENT: images(case)["base"]}, **rest)
        with pytest.raises(vla_cpp.UsageError, match="views of the policy"), make(absent=["nowhere"]) as policy:
            policy.act(images=images(case), **rest)


def test_what_is_said_wrongly_is_told_at_the_start(case):
    assert "a view of the policy" in refused("serve", case.bundle, "--bind", "tcp://127.0.0.1:0", "--absent", "nowhere")
    all_views = [a for view in case.images for a in ("--absent", view)]
    assert "at least" in refused("serve", case.bundle, "--bind", "tcp://127.0.0.1:0", *all_views)
    options = openpi_options("--absent", ABSENT, "--map", "other=front")
    assert "not --absent" in refused("serve", case.bundle, "--bind", "tcp://127.0.0.1:0", *options)


def test_vla_run_takes_it_too(case, tmp_path):
    expected = ran(case, tmp_path, "--seed", "7")
    options = ["--out", tmp_path / "absent.npy", "--absent", ABSENT, "--absent", "empty_camera_0"]
    arguments = case.arguments(images={view: case.images[view] for view in PRESENT}, options=options)
    at = arguments.index("--noise")
    arguments[at : at + 2] = ["--seed", "7"]
    subprocess.run([VLA, *map(str, arguments)], check=True, capture_output=True, timeout=SECONDS)
    assert np.load(tmp_path / "absent.npy").tobytes() == expected.tobytes()


def test_the_table_says_which_key_feeds_what_and_saves_what_the_policy_sees(case, tmp_path):
    lines = openpi_options("--absent", ABSENT)[2:]
    base = case.images["base"]
    done = subprocess.run(
        [VLA, "check", case.bundle, "--door", "openpi", *lines, "--image", f"observation/base={base}", "--save", tmp_path / "seen"],
        capture_output=True, text=True, timeout=SECONDS,
    )  # fmt: skip
    assert done.returncode == 0, done
    assert "observation/base\n    feeds the view observation.images.base: RGB" in done.stdout
    assert "observation.images.front: absent, as --absent says" in done.stdout
    assert "observation/state\n    feeds the state observation.state, 3 numbers: 0 " in done.stdout
    from PIL import Image

    with vla_cpp.Policy(case.bundle, threads=1) as policy:
        view = policy.spec.views[0]
    assert Image.open(tmp_path / "seen" / "base.png").size == (view.width, view.height)
    with serving(case, "--absent", ABSENT, "--first-frames", tmp_path / "first") as (_, address), vla_cpp.Client(address("tcp://"), timeout=SECONDS) as client:
        client.act(images=images(case), state=case.state, text=case.text, seed=7)
    assert sorted(path.name for path in (tmp_path / "first").iterdir()) == ["base.png", "wrist.png"]
    assert (tmp_path / "first" / "base.png").read_bytes() == (tmp_path / "seen" / "base.png").read_bytes()


@pytest.mark.parametrize("door", ["native", "gr00t", "lerobot"])
def test_the_table_of_every_door(case, door):
    done = subprocess.run([VLA, "check", case.bundle, "--door", door, "--absent", ABSENT], capture_output=True, text=True, timeout=SECONDS)
    assert done.returncode == 0 and "front: absent" in done.stdout and "feeds the state observation.state" in done.stdout, done

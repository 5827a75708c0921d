# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""LeRobot's asynchronous inference as `vla serve --lerobot` speaks it. Needs grpcio."""

import subprocess
import time

import numpy as np
import pytest

pytest.importorskip("msgpack")
grpc = pytest.importorskip("grpc")

import lerobot_pickles  # noqa: E402
from drop_in import serving  # noqa: E402
from lerobot_calls import BEGIN, PIECE, Robot, piece  # noqa: E402
from lerobot_pickles import Bomb, TimedObservation, dumps, setup_of  # noqa: E402
from server_process import SECONDS, VLA, frames  # noqa: E402


@pytest.fixture(scope="module")
def served(case):
    with serving(case, "--lerobot", "127.0.0.1:0") as (line, address):
        yield address("grpc://"), line


def cameras(case):
    return {
        view.removeprefix("observation.images."): frame for view, frame in frames(case).items() if frame is not None
    }


def motors(case):
    return [f"joint_{i}.pos" for i in range(len(case.state))]


def observation(case, timestep=0, must_go=True, shift=0.0, large=1):
    readings = {name: float(x) + shift for name, x in zip(motors(case), case.state)}
    seen = {name: np.repeat(np.repeat(frame, large, 0), large, 1) for name, frame in cameras(case).items()}
    return TimedObservation(1000.0 + timestep, timestep, {**readings, **seen, "task": case.text}, must_go)


@pytest.fixture
def robot(case, served):
    with Robot(served[0]) as robot:
        robot.begin(setup_of(motors(case), cameras(case)))
        yield robot


def test_a_chunk_is_the_policys_with_timesteps_and_times(case, robot):
    robot.observe(observation(case, 7))
    rows = robot.actions()
    assert [row.timestep for row in rows] == list(range(7, 7 + len(rows))) and rows[0].timestamp == 1007.0
    steps = np.diff([row.timestamp for row in rows])
    assert np.allclose(steps, steps[0]) and steps[0] > 0
    assert all(row.action.dtype == np.float32 and np.isfinite(row.action).all() for row in rows)


def test_the_task_of_a_client_that_was_started_without_one_is_empty_and_is_answered(case, robot):
    empty = observation(case, 7)
    empty.observation["task"] = ""  # RobotClientConfig.task by default
    robot.observe(empty)
    assert [row.timestep for row in robot.actions()][0] == 7


def test_recorded_acts_replay_to_the_same_chunk_bit_for_bit(case, tmp_path):
    with serving(case, "--lerobot", "127.0.0.1:0", "--record", tmp_path / "kept") as (_, address):
        with Robot(address("grpc://")) as robot:
            robot.begin(setup_of(motors(case), cameras(case)))
            for step, protocol in enumerate((4, 5, 4)):
                robot.observe(observation(case, step), protocol)
                assert robot.actions()
    replayed = subprocess.run(
        [VLA, "replay", tmp_path / "kept", "--bundle", case.bundle], capture_output=True, text=True
    )
    assert replayed.returncode == 0 and "3 " in replayed.stdout, replayed.stdout + replayed.stderr


def test_an_observation_in_pieces_is_one_and_a_chunk_is_no_longer_than_asked_for(case, served):
    with Robot(served[0]) as robot:
        robot.begin(setup_of(motors(case), cameras(case), actions_per_chunk=2))
        large = observation(case, large=16)
        assert len(dumps(large)) > 2 * PIECE
        robot.observe(large)
        assert len(robot.actions()) == 2


def test_what_is_computed_follows_the_rules_of_the_reference(case, robot):
    """must_go always; else not a timestep twice, and no state within 1 of the last one that was computed."""

    def is_computed(*arguments, **more):
        robot.observe(observation(case, *arguments, **more))
        return robot.actions() is not None

    far = 2 / len(case.state) ** 0.5
    assert is_computed(0, must_go=False)
    start = time.monotonic()
    assert not is_computed(1, must_go=False)
    assert 1.9 < time.monotonic() - start < SECONDS
    assert is_computed(1, must_go=False, shift=far) and not is_computed(1, must_go=False)
    assert is_computed(1, must_go=True)
    for step in (2, 3):
        robot.observe(observation(case, step))  # the newest of those that wait
    assert robot.actions()[0].timestep == 3


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda o: o.observation.pop("task"), "task"),
        (
            lambda o: o.observation.update({k: 1.0 for k in o.observation if hasattr(o.observation[k], "shape")}),
            "pixels",
        ),
        (lambda o: setattr(o, "timestep", -1), "timestep"),
        (lambda o: o.observation.update({"joint_0.pos": "fast"}), "joint_0.pos"),
        (lambda o: o.observation.update({"joint_0.pos": Bomb()}), "pathlib"),
    ],
)
def test_a_wrong_observation_is_a_status_with_words_and_the_next_one_is_answered(case, robot, change, words):
    wrong = observation(case)
    change(wrong)
    with pytest.raises(grpc.RpcError) as raised:
        robot.observe(wrong)
        robot.actions()
    assert raised.value.code() == grpc.StatusCode.INVALID_ARGUMENT and words in raised.value.details()
    robot.observe(observation(case))
    assert robot.actions()


def test_a_pickle_that_would_execute_is_refused_by_name(case, served, tmp_path):
    mark = lerobot_pickles.Path("/tmp/vla-pickle-bomb")
    mark.unlink(missing_ok=True)
    with Robot(served[0]) as robot:
        for bomb in (
            dumps(Bomb()),
            dumps(Bomb(), 2),
            b"cos\nsystem\n(X\x04\x00\x00\x00exittR.",
            b"\x80\x04\x8c\x02os\x8c\x06system\x93.",
        ):
            with pytest.raises(grpc.RpcError) as raised:
                robot.begin(bomb)
            assert raised.value.code() == grpc.StatusCode.INVALID_ARGUMENT and "the name " in raised.value.details()
    assert not mark.exists()


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda s: s.lerobot_features.pop("observation.state"), "observation.state"),
        (lambda s: s.lerobot_features["observation.state"].update(names=["a"]), "1: a"),
        (lambda s: s.lerobot_features.update({"observation.images.roof": {}}), "observation.images.roof"),
        (lambda s: setattr(s, "actions_per_chunk", 0), "actions_per_chunk"),
    ],
)
def test_a_robot_that_does_not_fit_is_refused_before_it_moves(case, served, change, words):
    wrong = setup_of(motors(case), cameras(case))
    change(wrong)
    with Robot(served[0]) as robot, pytest.raises(grpc.RpcError) as raised:
        robot.begin(wrong)
    assert raised.value.code() == grpc.StatusCode.INVALID_ARGUMENT and words in raised.value.details()


def test_calls_out_of_order_and_unknown_ones_say_so(case):
    with serving(case, "--lerobot", "127.0.0.1:0", "--max-message", "1") as (_, address), Robot(
        address("grpc://")
    ) as robot:
        for ask, code in [
            (robot.actions, grpc.StatusCode.FAILED_PRECONDITION),
            (lambda: robot.observe(observation(case)), grpc.StatusCode.FAILED_PRECONDITION),
            (lambda: robot.other(b""), grpc.StatusCode.UNIMPLEMENTED),
            (lambda: robot.observe(bytes(3 << 20)), grpc.StatusCode.INVALID_ARGUMENT),
            (lambda: robot._observe(iter([piece(BEGIN, b"half")])), grpc.StatusCode.INVALID_ARGUMENT),
            (lambda: robot._observe(iter([piece(0, b"")])), grpc.StatusCode.INVALID_ARGUMENT),
        ]:
            with pytest.raises(grpc.RpcError) as raised:
                ask()
            assert raised.value.code() == code, raised.value


def test_a_server_stops_while_robots_wait(case):
    with serving(case, "--lerobot", "127.0.0.1:0") as (_, address):
        robot = Robot(address("grpc://"))
        robot.begin(setup_of(motors(case), cameras(case)))
        waiting = robot.channel.unary_unary("/transport.AsyncInference/GetActions", None, None).future(b"")
        half = robot.channel.stream_unary("/transport.AsyncInference/SendObservations", None, None).future(slow())
        time.sleep(0.3)
    assert waiting.exception(SECONDS).code() == grpc.StatusCode.UNAVAILABLE
    half.cancel()
    robot.channel.close()


def slow():
    yield piece(BEGIN, b"half")
    time.sleep(3)

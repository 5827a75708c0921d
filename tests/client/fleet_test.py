# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""examples/fleet/ without Ray: what answers a message, the door that robots come in by, the counting of load.py, and the manifest."""

import asyncio
import contextlib
import os
import re
import shlex
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request

import numpy as np
import pytest

pytest.importorskip("websockets")

from server_process import ROOT, SECONDS, VLA  # noqa: E402
from websockets.exceptions import ConnectionClosed, InvalidStatus  # noqa: E402
from websockets.sync.client import connect  # noqa: E402

sys.path.append(str(ROOT / "examples/fleet"))

from engine import Engine  # noqa: E402
from front import Front, Lost  # noqa: E402
from load import Act, Robot, cases_of, kill_most_asked, report  # noqa: E402

import vla_cpp  # noqa: E402
from vla_cpp import openpi  # noqa: E402

BUNDLE = str(ROOT / "models/metaworld-tiny.gguf")
VIEW, STATE = "observation.images.corner4", "observation.state"
MANIFEST = ROOT / "examples/fleet/kubernetes.yaml"


@pytest.fixture(scope="module")
def engine():
    return Engine(BUNDLE)


@pytest.fixture(scope="module")
def cases():
    return cases_of(BUNDLE, 1, None, 3)


def message_of(case, **more):
    observation = case[0]
    content = {VIEW: observation["images"][VIEW], STATE: observation["state"][STATE], "prompt": observation["text"]}
    return {**content, "vla": {"seed": observation["seed"]}, **more}


def answered(engine, message):
    answer = engine.act(openpi.pack(message))
    return answer if isinstance(answer, str) else openpi.unpack(answer, "engine")


# --- what answers a message


def test_an_engine_answers_with_the_chunk_of_the_policy_and_says_who_it_is(engine, cases):
    for case in cases:
        answer = answered(engine, message_of(case))
        assert answer["actions"].tobytes() == case[1] and answer["seed"] == case[0]["seed"]
        assert answer["replica"] == openpi.unpack(engine.greeting(), "engine")["replica"] == f"{os.uname().nodename}:{os.getpid()}"
    message = message_of(cases[0])
    del message["vla"]
    assert answered(engine, message)["seed"] != answered(engine, message)["seed"]


def test_an_engine_takes_the_keys_that_it_is_told(cases):
    engine = Engine(BUNDLE, [f"images/top={VIEW}", f"observation/state={STATE}", "say=text"])
    observation = cases[0][0]
    message = {"images": {"top": observation["images"][VIEW]}, "observation/state": observation["state"][STATE]}
    message.update({"say": observation["text"], "vla": {"seed": observation["seed"]}})
    assert answered(engine, message)["actions"].tobytes() == cases[0][1]
    with pytest.raises(vla_cpp.UsageError, match=VIEW):
        Engine(BUNDLE, ["top=observation.images.top"])


@pytest.mark.parametrize(
    "change, words",
    [
        ({"wrist": 1}, "bad_observation: message: expected the keys"),
        ({STATE: np.zeros(9, np.float32)}, f"bad_observation: {STATE}"),
        ({STATE: "here"}, f"bad_observation: {STATE}"),
        ({VIEW: np.zeros((3, 8, 8), np.float32)}, f"bad_observation: {VIEW}"),
        ({"prompt": 3}, "bad_observation: instruction"),
        ({"images": 3}, "bad_observation: images"),
        ({"vla": {"seed": -1}}, "bad_observation: vla.seed"),
        ({"vla": {"deadline_ms": 5}}, "bad_observation: vla: expected a map with `seed` and nothing else"),
    ],
)
def test_an_observation_that_does_not_fit_is_refused_by_name(engine, cases, change, words):
    assert answered(engine, message_of(cases[0], **change)).startswith(words)


@pytest.mark.parametrize("message", [b"", b"\xc1", b"\x93", "text", openpi.pack([1]), openpi.pack({"nd": True, "type": "O", "data": b""})])
def test_other_bytes_are_refused(engine, message):
    assert re.match("incompatible: message|bad_observation: message", engine.act(message))


def test_a_message_of_many_values_is_refused_at_once(engine):
    n = 60_000_000
    start = time.process_time()
    assert "more than 4096 values" in engine.act(b"\xdd" + n.to_bytes(4, "big") + b"\x80" * n)
    assert time.process_time() - start < 1


# --- the door


class Door:
    """A front that listens, on a thread of its own. `act` is asynchronous."""

    def __init__(self, act, greet=None, limit=8, **more):
        async def hello(robot):
            return openpi.pack({"server": "vla.cpp test", "robot": robot})

        self.front = Front(greet or hello, act, limit, **more)
        self.loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self.loop.run_forever, daemon=True)
        self._thread.start()
        server = self.call(self._listen())
        self.place = "127.0.0.1:{}".format(server.sockets[0].getsockname()[1])

    async def _listen(self):
        self._listening = self.front.listen("127.0.0.1", 0)
        return await self._listening.__aenter__()

    def call(self, coroutine):
        return asyncio.run_coroutine_threadsafe(coroutine, self.loop).result(SECONDS)

    def start_drain(self):
        return asyncio.run_coroutine_threadsafe(self.front.drain(SECONDS), self.loop)

    def connect(self, robot="", **more):
        return connect(f"ws://{self.place}/{robot}", compression=None, proxy=None, **more)

    def page(self, path):
        try:
            with urllib.request.urlopen(f"http://{self.place}{path}", timeout=SECONDS) as page:
                return page.status, page.read()
        except urllib.error.HTTPError as error:
            return error.code, error.read()

    def close(self):
        self.call(self._listening.__aexit__(None, None, None))
        self.loop.call_soon_threadsafe(self.loop.stop)
        self._thread.join()
        self.loop.close()


@contextlib.contextmanager
def door(*arguments, **more):
    door = Door(*arguments, **more)
    try:
        yield door
    finally:
        door.close()


async def echo(robot, message):
    return b"%s of %s" % (message, robot.encode())


def test_a_robot_has_the_name_of_its_path_and_else_one_of_its_own():
    with door(echo) as front, front.connect("arm-7") as named, front.connect() as one, front.connect() as other:
        assert openpi.unpack(named.recv(SECONDS), "front")["robot"] == "arm-7"
        named.send(b"act")
        assert named.recv(SECONDS) == b"act of arm-7"
        assert openpi.unpack(one.recv(SECONDS), "front")["robot"] != openpi.unpack(other.recv(SECONDS), "front")["robot"]


def test_a_refusal_is_text_and_the_end_of_the_connection_as_in_openpi():
    async def refuse(robot, message):
        return "bad_observation: state: expected 4 values"

    with door(refuse) as front:
        names = [f"{VIEW}=top", f"{STATE}=arm", "prompt=text"]
        with vla_cpp.OpenpiClient(f"openpi://{front.place}", names, timeout=SECONDS) as client:
            with pytest.raises(vla_cpp.BadObservation, match="expected 4 values"):
                client.act(images={"top": np.zeros((4, 4, 3), np.uint8)}, state={"arm": [1.0]}, text="go")
        with front.connect() as robot:
            robot.recv(SECONDS), robot.send(b"act"), robot.recv(SECONDS)
            with pytest.raises(ConnectionClosed) as closed:
                robot.recv(SECONDS)
            assert closed.value.rcvd.code == 1011


def test_who_answers_and_dies_is_told_and_the_next_connection_works():
    broken = [True]

    async def act(robot, message):
        if broken.pop() if broken else False:
            raise Lost("two replicas failed")
        return await echo(robot, message)

    with door(act) as front:
        with front.connect() as robot:
            robot.recv(SECONDS), robot.send(b"act")
            with pytest.raises(ConnectionClosed) as closed:
                robot.recv(SECONDS)
            assert (closed.value.rcvd.code, closed.value.rcvd.reason) == (1012, "two replicas failed; connect again")
        with front.connect("a") as robot:
            robot.recv(SECONDS), robot.send(b"act")
            assert robot.recv(SECONDS) == b"act of a"


def test_draining_answers_the_act_under_way_and_sends_every_robot_away():
    begun, free = threading.Event(), threading.Event()

    async def act(robot, message):
        begun.set()
        while not free.is_set():
            await asyncio.sleep(0.01)
        return b"answer"

    with door(act) as front, front.connect() as idle, front.connect() as busy:
        assert front.page("/healthz") == front.page("/readyz") == (200, b"OK\n")
        idle.recv(SECONDS), busy.recv(SECONDS)
        busy.send(b"act")
        assert begun.wait(SECONDS)
        draining = front.start_drain()
        with pytest.raises(ConnectionClosed) as closed:
            idle.recv(SECONDS)
        assert (closed.value.rcvd.code, closed.value.rcvd.reason) == (1001, "the server drains; connect again")
        assert front.page("/healthz")[0] == 200 and front.page("/readyz") == (503, b"draining\n")
        with pytest.raises(InvalidStatus, match="503"):
            front.connect().__enter__()
        assert not draining.done()
        free.set()
        assert busy.recv(SECONDS) == b"answer"
        with pytest.raises(ConnectionClosed) as closed:
            busy.recv(SECONDS)
        assert closed.value.rcvd.code == 1001
        draining.result(SECONDS)


def test_browsers_and_one_robot_too_many_are_refused():
    with door(echo, limit=1) as front:
        with pytest.raises(InvalidStatus, match="403"):
            front.connect(origin="http://example.org").__enter__()
        with front.connect() as robot:
            robot.recv(SECONDS)
            with pytest.raises(InvalidStatus, match="503"):
                front.connect().__enter__()


def test_connections_that_never_ask_are_bounded_in_number_and_time_and_a_robot_beside_them_is_answered(monkeypatch):
    monkeypatch.setattr("front.HANDSHAKE", 1.0)
    with door(echo, most_handshakes=8) as front:
        host, _, port = front.place.partition(":")
        silent = [socket.create_connection((host, int(port)), SECONDS) for _ in range(40)]
        with front.connect("arm") as robot:
            robot.recv(SECONDS)
            robot.send(b"act")
            assert robot.recv(SECONDS) == b"act of arm"
            for connection in silent[:32]:
                connection.settimeout(SECONDS)
                assert ended(connection)  # for those that came after it
            begun = time.monotonic()
            assert all(ended(connection) for connection in silent)
            assert time.monotonic() - begun < 5, "the time of a handshake"
            robot.send(b"again")
            assert robot.recv(SECONDS) == b"again of arm"
        assert front.page("/healthz") == (200, b"OK\n")


def ended(connection):
    try:
        return connection.recv(1) == b""
    except ConnectionResetError:
        return True


# --- load.py


def test_robots_compare_each_answer_and_connect_again(engine, cases):
    answers = []

    async def act(robot, message):
        answers.append(engine.act(message))
        if len(answers) == 3:
            return "internal: once"
        return answers[0] if len(answers) == 5 else answers[-1]  # the fifth is the answer to another seed

    async def greet(robot):
        return engine.greeting()

    with door(act, greet) as front:
        robot = Robot(f"openpi://{front.place}/arm", cases, 20, start=0, end=0)
        kinds = [robot._ask(*cases[i % 3]) for i in range(6)]
        robot._client.close()
    assert kinds == ["right", "right", "lost", "right", "wrong", "right"]
    assert robot.replica == engine.replica


def steady(since, until, rate, kind="right", took=0.01):
    return [Act(t, t, t + took, kind) for t in np.arange(since, until, 1 / rate)]


def test_a_report_counts_and_times_what_a_kill_did():
    lost = [Act(10.0, 9.99, 10.02, "lost"), Act(10.5, 10.5, 10.52, "lost")]
    acts = steady(0, 10, 20) + lost + steady(10.6, 13, 10) + steady(13, 30, 20)
    told = report(acts, 20, 10.0, 30.0)
    assert (told["asked"], told["lost"], told["under_way_at_kill"], told["lost_beyond"]) == (len(acts), 2, 1, 1)
    assert told["full_rate_after_s"] == pytest.approx(3.0, abs=0.3) and told["in_time_a_second_before"] == 20
    assert told["late"] == told["wrong"] == 0
    assert report(steady(0, 10, 20) + steady(10, 30, 10), 20, 10.0, 30.0)["full_rate_after_s"] is None
    late = report(steady(0, 10, 20) + steady(10, 30, 20, took=0.06), 20, 10.0, 30.0)
    assert late["late"] > 300 and late["full_rate_after_s"] is None  # answers that nobody waits for any more
    assert report(steady(0, 1, 20, "wrong"), 20, None, 1.0)["wrong"] == 20


def test_only_a_process_of_this_machine_is_killed():
    robot = Robot("openpi://127.0.0.1:1", [({"images": {}, "state": {}}, b"")], 1, 0, 0)
    for replica in ("", "elsewhere:1", "elsewhere"):
        robot.replica = replica
        with pytest.raises(SystemExit, match="expected a replica on this machine"):
            kill_most_asked([robot])


# --- the manifest


@pytest.fixture(scope="module")
def objects():
    yaml = pytest.importorskip("yaml")
    return {content["kind"]: content for content in yaml.safe_load_all(MANIFEST.read_text())}


def pod_of(objects):
    return objects["Deployment"]["spec"]["template"]["spec"]


def test_the_manifest_is_consistent(objects):
    assert set(objects) == {"Deployment", "Service", "PodDisruptionBudget"}
    labels = objects["Deployment"]["spec"]["template"]["metadata"]["labels"]
    assert labels == objects["Deployment"]["spec"]["selector"]["matchLabels"]
    assert labels == objects["Service"]["spec"]["selector"] == objects["PodDisruptionBudget"]["spec"]["selector"]["matchLabels"]
    pod = pod_of(objects)
    (server,) = pod["containers"]
    ports = {port["name"]: port["containerPort"] for port in server["ports"]}
    assert objects["Service"]["spec"]["ports"][0]["targetPort"] in ports
    volumes = {volume["name"] for volume in pod["volumes"]}
    for container in pod["initContainers"] + pod["containers"]:
        assert {mount["name"] for mount in container["volumeMounts"]} <= volumes
        assert container["resources"]["requests"] == container["resources"]["limits"]
        assert set(container["resources"]["limits"]) == {"cpu", "memory"}
    assert f"--threads={server['resources']['limits']['cpu']}" in server["command"]
    assert {server[probe]["httpGet"]["path"] for probe in ("startupProbe", "readinessProbe")} == {"/readyz"}
    assert server["livenessProbe"]["httpGet"]["path"] == "/healthz"
    assert {server[probe]["httpGet"]["port"] for probe in ("startupProbe", "readinessProbe", "livenessProbe")} == {"metrics"}
    assert pod["terminationGracePeriodSeconds"] > 0 and pod["securityContext"]["runAsNonRoot"]


def test_the_manifest_starts_a_server_with_keys_which_drains_before_it_stops(objects, tmp_path):
    """Its commands as they are, with folders of this machine for those that are mounted."""
    pod = pod_of(objects)
    (server,) = pod["containers"]
    for name in ("server", "arm", "stranger"):
        subprocess.run([VLA, "keygen", tmp_path / name], check=True, capture_output=True)
    for mount in ("secret", "keys", "policies", "run"):
        (tmp_path / mount).mkdir()
    (tmp_path / "server.secret").rename(tmp_path / "secret/server.secret")
    (tmp_path / "secret/server.secret").chmod(0o440)
    (tmp_path / "secret/clients.public").write_text((tmp_path / "arm.public").read_text())
    (tmp_path / "policies/policy.gguf").symlink_to(BUNDLE)

    def here(words):
        mounts = {mount["mountPath"]: mount["name"] for container in (*pod["initContainers"], server) for mount in container["volumeMounts"]}
        for path in sorted(mounts, key=len, reverse=True):
            words = [re.sub(rf"(?<![\w/]){path}/", f"{tmp_path}/{mounts[path]}/", word) for word in words]
        words = [re.sub(r"\bvla (?=ctl)", f"{VLA} ", word) for word in words]
        ports = {"tcp://*:5555": "tcp://127.0.0.1:0", "0.0.0.0:9090": "0.0.0.0:0"}
        return [VLA if word == "vla" else re.sub(r"=(.*)", lambda m: "=" + ports.get(m[1], m[1]), word) if word.startswith("--") else word for word in words]

    subprocess.run(here(pod["initContainers"][0]["command"]), check=True)
    assert (tmp_path / "keys/server.secret").stat().st_mode & 0o777 == 0o600
    process = subprocess.Popen(here(server["command"]), stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    try:
        told = dict(field.split("=", 1) for field in shlex.split(process.stdout.readline())[1:])
        for probe in ("readinessProbe", "livenessProbe"):
            with urllib.request.urlopen(f"http://{told['metrics']}{server[probe]['httpGet']['path']}", timeout=SECONDS) as page:
                assert page.status == 200
        public = tmp_path / "server.public"
        for keys in ({"server_key": public, "secret_key": tmp_path / "stranger.secret"}, {}):
            with vla_cpp.Client(told["address"], timeout=2, **keys) as stranger:
                with pytest.raises((vla_cpp.Disconnected, vla_cpp.Timeout)):
                    stranger.health()
        with vla_cpp.Client(told["address"], server_key=public, secret_key=tmp_path / "arm.secret", timeout=SECONDS) as client:
            assert client.spec.bundle.name == "policy.gguf"
        stop = here(server["lifecycle"]["preStop"]["exec"]["command"])
        assert subprocess.run(stop, timeout=pod["terminationGracePeriodSeconds"]).returncode == 0
        assert process.wait(SECONDS) == 0
    finally:
        process.kill()
        process.wait()
        process.stdout.close()

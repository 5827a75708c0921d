# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""vla serve --page: what it gives to whom, and what a browser shows of it."""

import json
import re
import shlex
import shutil
import socket
import subprocess
import threading
import time
import urllib.error
import urllib.request
from urllib.parse import parse_qs, urlencode, urlsplit

import numpy as np
import pytest
from golden_cases import Golden, tensors
from server_process import SECONDS, VLA, frames

import vla_cpp
from vla_cpp.control import ChunkLoop
from vla_cpp.recording import Recording, acts_of

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")


class Shown:
    """A process with a page, and what the page gives."""

    robot, n_act = None, 0

    def __init__(self, *command):
        self.process = subprocess.Popen([VLA, *command, "--page", "127.0.0.1:0"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        self.told = dict(word.partition("=")[::2] for word in shlex.split(self.process.stdout.readline()))
        self.url = self.told["page"]
        self.token = parse_qs(urlsplit(self.url).query)["token"][0]

    def get(self, path, token=None, method="GET", **query):
        """Status, type and body."""
        parts = urlsplit(self.url)
        query = urlencode({"token": self.token if token is None else token, **query})
        request = urllib.request.Request(f"http://{parts.netloc}/{path}?{query}", method=method)
        try:
            with urllib.request.urlopen(request, timeout=SECONDS) as reply:
                return reply.status, reply.headers["Content-Type"], reply.read()
        except urllib.error.HTTPError as error:
            return error.code, error.headers["Content-Type"], error.read()

    def post(self, on, **options):
        """Asks for a recording, or its end: status, and the answer."""
        status, kind, body = self.get("record", method="POST", on=on, **options)
        return status, json.loads(body) if kind == "application/json" else body.decode()

    def picture(self, **query):
        """A frame that comes as pixels, (height, width, 3)."""
        status, kind, body = self.get("image", **query)
        assert (status, kind) == (200, "image/x-portable-pixmap"), body
        head, _, rows = body.partition(b"\n")
        mark, width, height, largest = head.split()
        assert (mark, largest) == (b"P6", b"255")
        return np.frombuffer(rows, np.uint8).reshape(int(height), int(width), 3)

    def acts(self, after=0):
        """Waits for the last act: it may be answered before the page knows."""
        while (told := json.loads(self.get("acts", after=after)[2]))["last"] < self.n_act:
            time.sleep(0.01)
        return told

    def stop(self):
        if self.robot:
            self.robot.close()
        self.process.terminate()
        self.process.communicate(timeout=SECONDS)
        return self.process.returncode


class Watched(Shown):
    """A server with a page, and a robot."""

    def __init__(self, case, *options):
        super().__init__("serve", case.bundle, "--bind", "tcp://127.0.0.1:0", "--threads", "1", *options)
        ready = self.told
        self.robot = vla_cpp.Client(ready["address"], timeout=SECONDS)
        self.case = case
        self.n_act = 0
        self.sent = {name: frame if i else frame[:40, :60] for i, (name, frame) in enumerate(frames(case).items())}
        self.files = {name: file.read_bytes() for name, file in list(case.images.items())[1:]}

    def act(self, text="open the drawer", state=None, **options):
        """The first view as pixels, the others as files."""
        images = {**self.sent, **self.files}
        self.n_act += 1
        return self.robot.act(images=images, state=self.case.state if state is None else state, text=text, seed=1, **options)


@pytest.fixture(scope="module")
def watched(case):
    watched = Watched(case)
    yield watched
    assert watched.stop() == 0


def test_nothing_is_given_without_the_token(watched):
    watched.act()
    assert re.fullmatch("[0-9a-f]{32}", watched.token)
    for token in ("", watched.token[:-1], watched.token[:-1] + "x", watched.token + "0"):
        for path in ("", "policy", "acts", "image", "nothing"):
            status, _, body = watched.get(path, token=token, act=1, view=0)
            assert status == 403 and b"token" in body and len(body) < 200
    assert watched.get("nothing")[0] == 404


def test_the_page_loads_nothing_from_elsewhere(watched):
    status, kind, body = watched.get("")
    assert status == 200 and kind.startswith("text/html")
    assert not re.search(rb"https?://|src=|@import|<link", body)


def test_an_act_is_told_with_its_frames(watched):
    last = watched.acts()["last"]
    chunk = watched.act(deadline_ms=5000)
    told = watched.acts(after=last)
    (act,) = told["acts"]
    assert told["last"] == act["id"] == last + 1 and told["ready"] and told["chunks"] >= 1
    assert (act["text"], act["code"], act["deadline_ms"]) == ("open the drawer", "ok", 5000)
    assert act["name"].startswith("vla-cpp-python") and abs(act["at_ms"] / 1000 - time.time()) < 60
    assert np.array_equal(np.float32(act["chunk"]["actions"]).reshape(chunk.actions.shape), chunk.actions)
    assert dict(act["chunk"]["stages"]) == pytest.approx(chunk.timing)
    assert act["total_ms"] >= sum(chunk.timing.values()) * 0.99
    assert np.array_equal(np.float32(next(iter(act["states"].values()))), np.float32(watched.case.state))
    for i, view in enumerate(act["views"]):
        status, kind, body = watched.get("image", act=act["id"], view=i)
        assert status == 200
        if view["kind"] == "rgb":
            head, _, rows = body.partition(b"\n")
            sent = watched.sent[view["name"]]
            assert head == f"P6 {sent.shape[1]} {sent.shape[0]} 255".encode() and rows == sent.tobytes()
        else:
            assert (kind, body) == ("image/png", watched.files[view["name"]])
    assert watched.get("image", act=act["id"], view=9)[0] == watched.get("image", act=10**18, view=0)[0] == 404


def pixels_of(case, folder):
    """What the network gets of the case's frames, (n_view, 3, height, width)."""
    subprocess.run([VLA, *map(str, case.arguments(options=("--tap", "pixels", "--taps-out", folder / "taps.gguf")))], check=True, capture_output=True)
    return tensors(folder / "taps.gguf")["pixels"]


def check_picture(shown, pixels):
    """Bytes of planes (3, height, width) that the recipe ends with 2 x - 1, but for how halves are rounded."""
    expected = 255 * (pixels.transpose(1, 2, 0) * 0.5 + 0.5)
    assert shown.shape == expected.shape and np.abs(shown - expected).max() < 0.501


def test_frames_are_shown_as_the_network_gets_them(watched, tmp_path):
    sent, watched.sent, watched.files = (watched.sent, watched.files), frames(watched.case), {}
    watched.act()
    watched.sent, watched.files = sent
    act = watched.acts()["acts"][-1]
    pixels = pixels_of(watched.case, tmp_path)
    for index, view in enumerate(act["views"]):
        shown = watched.picture(act=act["id"], view=index, **{"as": "seen"})
        check_picture(shown, pixels[list(watched.case.images).index(view["name"])])
        assert watched.picture(act=act["id"], view=index).shape != shown.shape, "the recipe resizes"
    assert json.loads(watched.get("policy")[2])["sees"]


def test_of_a_view_that_no_policy_has_there_is_no_picture(watched):
    last = watched.acts()["last"]
    with pytest.raises(vla_cpp.BadObservation):
        (first, frame), *_ = watched.sent.items()
        watched.robot.act(images={first: frame, "tail": np.zeros((4, 4, 3), np.uint8)}, state=watched.case.state, text="go", seed=1)
    watched.n_act += 1
    (act,) = watched.acts(after=last)["acts"]
    index = [view["name"] for view in act["views"]].index("tail")
    status, _, body = watched.get("image", act=act["id"], view=index, **{"as": "seen"})
    assert status == 404 and b"tail" in body
    assert watched.picture(act=act["id"], view=index).shape == (4, 4, 3)


def texts(folder):
    """The instructions of a recording that is whole."""
    recording = Recording(folder)
    found = [act.text for act in acts_of(recording)]
    assert recording.is_whole
    return found


def test_a_recording_is_ended_and_another_begun(case, tmp_path):
    watched = Watched(case, "--record", tmp_path / "r", "--record-limit", "100")
    watched.act(text="first")
    watched.acts()
    record = watched.acts()["record"]
    assert record["on"] and record["folder"] == str(tmp_path / "r") and record["max_bytes"] == 100_000_000
    status, ended = watched.post(0)
    assert status == 200 and not ended["on"] and not ended["why"] and ended["requests"] >= 1
    assert texts(tmp_path / "r") == ["first"], "whole once it is ended, while the server runs"
    watched.act(text="between")
    watched.acts()
    assert watched.post(0)[0] == 409, "none runs"
    status, begun = watched.post(1)
    assert status == 200 and begun["on"] and begun["requests"] == 0 and begun["bytes"] >= ended["bytes"]
    assert watched.post(1)[0] == 409, "one runs"
    watched.act(text="second")
    watched.acts()
    assert watched.acts()["record"]["requests"] == 1
    assert watched.stop() == 0
    (below,) = [path for path in (tmp_path / "r").iterdir() if path.is_dir()]
    assert str(below) == begun["folder"] and texts(below) == ["second"]
    assert texts(tmp_path / "r") == ["first"]


def test_a_paused_recording_waits_for_the_page(case, tmp_path):
    watched = Watched(case, "--record", tmp_path / "r", "--record-paused")
    watched.act(text="before")
    told = watched.acts()["record"]
    assert not told["on"] and told["folder"] == "" and not (tmp_path / "r").exists()
    assert watched.post(1)[0] == 200
    watched.act(text="asked for")
    watched.acts()
    assert watched.stop() == 0
    (folder,) = (tmp_path / "r").iterdir()
    assert texts(folder) == ["asked for"]


def test_a_recording_is_begun_by_those_who_have_the_token_and_where_there_is_a_folder(watched):
    for token in ("", watched.token[:-1]):
        assert watched.post(1, token=token)[0] == 403
    status, why = watched.post(1)
    assert status == 409 and "--record DIR" in why
    assert watched.get("record", on=1)[0] == 404, "by POST alone"
    assert watched.post("x")[0] == watched.get("acts", method="POST")[0] == 404
    assert watched.get("acts", method="DELETE")[0] == 405
    assert watched.acts()["record"] == {"on": False}


def test_the_policy_is_told_with_the_range_of_its_states(watched):
    policy = json.loads(watched.get("policy")[2])
    (robot,) = policy["robots"]
    (state,) = robot["states"]
    assert policy["arch"] == "smolvla" and robot["horizon"] == 5 and len(robot["actions"]) == 7
    assert len(state["low"]) == len(state["high"]) == len(state["dimensions"]) == 6
    assert all(low <= high for low, high in zip(state["low"], state["high"]))


def test_a_refusal_is_told(watched):
    last = watched.acts()["last"]
    with pytest.raises(vla_cpp.BadObservation):
        watched.act(text=None)
    (act,) = watched.acts(after=last)["acts"]
    assert act["code"] == "bad_observation" and act["error"]["where"] == "instruction" and "chunk" not in act


def drive(watched):
    """A loop that asks three times: before a command, before one that is cut, and while a person drives. The first chunk."""
    observation = dict(images={**watched.sent, **watched.files}, state=watched.case.state, text="open the drawer", seed=1)
    options = dict(replan_every=1, mode="sync", blend="linear", fade_steps=1, on_late="hold", on_note="ignore", max_jump=1e-6)
    with ChunkLoop(watched.robot, rate_hz=1000, allow_other_rate=True, **options, clock=lambda: 0.0) as loop:
        chunk = loop.step(observation).chunk
        assert loop.step(observation).limited
        loop.take_over("ana")
        loop.step(observation, human=chunk[0])
    watched.n_act += 3
    return chunk


def test_the_state_of_a_loop_is_told_and_recorded_and_changes_no_answer(case, tmp_path):
    watched = Watched(case, "--record", tmp_path / "r")
    chunk = watched.act()
    assert np.array_equal(drive(watched), chunk)
    alone, *told = [act.get("loop") for act in watched.acts()["acts"]]
    assert alone is None
    nothing = dict.fromkeys(("actions", "human", "held", "missed", "limited", "refused"), 0)
    assert told == [
        {**nothing, "driver": "POLICY"}, {**nothing, "driver": "POLICY", "actions": 1}, {**nothing, "driver": "PERSON", "actions": 2, "limited": 1},
    ]  # fmt: skip
    assert watched.stop() == 0
    again = subprocess.run([VLA, "replay", tmp_path / "r", "--bundle", case.bundle], capture_output=True, text=True)
    assert again.returncode == 0, again.stdout + again.stderr


def test_old_acts_go_and_a_viewer_that_was_away_gets_the_newest(case):
    watched = Watched(case)
    size = 3 * 2048 * 2048
    watched.sent = {next(iter(watched.sent)): np.zeros((2048, 2048, 3), np.uint8)}
    n = (96 << 20) // size + 3
    for _ in range(n):
        watched.act()
    told = watched.acts()
    assert told["last"] == n and 1 < told["first"] <= n and [a["id"] for a in told["acts"]] == list(range(told["first"], n + 1))
    assert watched.get("image", act=1, view=0)[0] == 404
    assert watched.stop() == 0


def test_a_viewer_that_does_not_read_holds_nothing_up(watched):
    parts = urlsplit(watched.url)
    held = [socket.create_connection((parts.hostname, parts.port)) for _ in range(80)]
    for connection in held[:40]:
        connection.sendall(f"GET /?token={watched.token} HTTP/1.1\r\nHost: x\r\n\r\n".encode())
    begun = time.monotonic()
    watched.act()
    assert watched.acts()["acts"] and time.monotonic() - begun < 10
    for connection in held:
        connection.close()


@pytest.fixture(scope="module")
def browser():
    playwright = pytest.importorskip("playwright.sync_api")
    if CHROMIUM is None:
        pytest.skip("no chromium")
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


def wait_for(page, expression):
    """Asks from outside: the page's policy forbids what waits inside."""
    until = time.monotonic() + 2 * SECONDS
    while not page.evaluate(expression):
        assert time.monotonic() < until, expression
        time.sleep(0.02)


def test_a_browser_shows_what_happens_and_can_step_back(watched, browser):
    faults = []
    page = browser.new_page(viewport={"width": 390, "height": 844}, color_scheme="dark")  # a phone
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.on("console", lambda message: faults.append(message.text) if message.type == "error" else None)
    page.goto(watched.url)
    stop = threading.Event()

    def robot():
        count = 0
        while not stop.wait(0.05):
            count += 1
            watched.act(text=f"instruction {count}", state=np.asarray(watched.case.state) + (1e3 if count > 40 else 0))

    thread = threading.Thread(target=robot)
    thread.start()
    try:
        wait_for(page, "parseInt(document.getElementById('text').textContent.split(' ')[1]) >= 30")
        assert page.locator("#frames canvas").count() == 2 and page.locator("#curves canvas").count() == 7
        assert "smolvla" in page.inner_text("#policy") and "receipt to answer" in page.inner_text("#times")
        pixels = "[...document.querySelectorAll('#frames canvas')].find(c => c.width === 60 && c.height === 40).getContext('2d').getImageData(0, 0, 60, 40).data"
        shown = np.array(page.evaluate(f"Array.from({pixels})"), np.uint8).reshape(40, 60, 4)
        assert np.array_equal(shown[..., :3], next(iter(watched.sent.values())))
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), "wider than a phone"
        page.click("#pause")
        paused = page.inner_text("#text")
        wait_for(page, "document.querySelectorAll('#events .note').length > 0")
        assert page.inner_text("#text") == paused
        page.click("#before")
        assert page.inner_text("#text") == f"instruction {int(paused.split()[1]) - 1}"
        page.click("#pause")
        wait_for(page, "document.querySelectorAll('#state .far').length > 0")
    finally:
        stop.set()
        thread.join()
    assert not faults
    page.close()


def test_a_browser_shows_who_drives_and_what_a_loop_cuts(case, browser):
    watched = Watched(case)
    faults = []
    page = browser.new_page()
    page.on("pageerror", lambda error: faults.append(str(error)))
    try:
        watched.act()
        page.goto(watched.url)
        wait_for(page, "document.getElementById('text').textContent !== ''")
        assert not page.is_visible("#loop")
        drive(watched)
        wait_for(page, "document.getElementById('driver').textContent === 'A person drives'")
        assert page.get_attribute("#driver", "class") == "note"
        assert page.locator("#counts .far").all_inner_texts() == ["limited\t1"]
        page.click("#before")
        assert page.inner_text("#driver") == "The policy drives" and not page.locator("#counts .far").count()
        assert not faults
    finally:
        page.close()
        assert watched.stop() == 0


def test_a_browser_switches_to_what_the_policy_sees_and_records(case, browser, tmp_path):
    watched = Watched(case, "--record", tmp_path / "r", "--record-paused")
    faults = []
    page = browser.new_page()
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.on("console", lambda message: faults.append(message.text) if message.type == "error" else None)
    try:
        watched.act()
        page.goto(watched.url)
        widths = "[...document.querySelectorAll('#frames canvas')].map(c => c.width)"
        wait_for(page, f"{widths}.includes(60)")  # as it was sent
        page.select_option("#as", "seen")
        _, height, width = pixels_of(case, tmp_path)[0].shape
        wait_for(page, f"{widths}.length === 2 && {widths}.every(w => w === {width})")
        assert "recipe" in page.inner_text("#recipe") and f"{width} x {height}" in page.inner_text("#frames")
        read = f"document.querySelector('#frames canvas').getContext('2d').getImageData(0, 0, {width}, {height}).data"
        shown = np.array(page.evaluate(f"Array.from({read})"), np.uint8).reshape(height, width, 4)[..., :3]
        assert np.array_equal(shown, watched.picture(act=1, view=0, **{"as": "seen"}))
        assert page.inner_text("#record") == "Record"
        page.click("#record")
        wait_for(page, "document.getElementById('record').textContent === 'Stop recording'")
        watched.act(text="for the record")
        wait_for(page, "document.getElementById('recorded').textContent.startsWith('1 requests')")
        page.click("#record")
        wait_for(page, "document.getElementById('record').textContent === 'Record'")
        (folder,) = (tmp_path / "r").iterdir()
        assert texts(folder) == ["for the record"]
        assert not faults
    finally:
        page.close()
        assert watched.stop() == 0


def test_a_browser_is_told_why_nothing_is_recorded(watched, browser):
    page = browser.new_page()
    page.goto(watched.url)
    wait_for(page, "!document.getElementById('record').hidden")
    page.click("#record")
    wait_for(page, "document.getElementById('recorded').textContent.includes('--record DIR')")
    page.close()


def test_a_recording_is_shown_as_it_happened(case, tmp_path):
    recorder = subprocess.Popen([VLA, "serve", case.bundle, "--bind", "tcp://127.0.0.1:0", "--threads", "1", "--record", tmp_path / "r"],
                                stdout=subprocess.PIPE, text=True)  # fmt: skip
    address = dict(word.partition("=")[::2] for word in shlex.split(recorder.stdout.readline()))["address"]
    with vla_cpp.Client(address, timeout=SECONDS) as robot:
        chunks = [robot.act(images=frames(case), state=case.state, text=text, seed=1) for text in ("open the drawer", "close it")]
        with pytest.raises(vla_cpp.BadObservation):
            robot.act(images=frames(case), state=[1.0], text="open the drawer")
    recorder.terminate()
    recorder.communicate(timeout=SECONDS)
    shown = Shown("replay", tmp_path / "r", "--speed", "1000")
    try:
        shown.n_act = 3
        *acts, refused = shown.acts()["acts"]
        assert [act["text"] for act in acts] == ["open the drawer", "close it"]
        assert refused["code"] == "bad_observation" and refused["error"]["where"] and "chunk" not in refused
        for act, chunk in zip(acts, chunks):
            assert np.array_equal(np.float32(act["chunk"]["actions"]).reshape(chunk.actions.shape), chunk.actions)
            assert act["code"] == "ok" and abs(act["at_ms"] / 1000 - time.time()) < 60
            assert act["total_ms"] == pytest.approx(chunk.queue_ms + sum(chunk.timing.values()))
        assert shown.get("image", act=1, view=0)[0] == 200
        policy = json.loads(shown.get("policy")[2])
        assert policy["robots"][0]["horizon"] == chunks[0].actions.shape[0] and not policy["sees"]
        status, _, why = shown.get("image", act=1, view=0, **{"as": "seen"})
        assert status == 404 and b"--bundle" in why
        assert shown.acts()["record"] is None and shown.post(1)[0] == 409
        assert shown.process.stdout.readline() == "3 acts were shown; Ctrl-C ends the page\n"
    finally:
        shown.process.terminate()
        shown.process.communicate(timeout=SECONDS)
    seen = Shown("replay", tmp_path / "r", "--speed", "1000", "--bundle", case.bundle)
    try:
        seen.n_act = 3
        policy, act = json.loads(seen.get("policy")[2]), seen.acts()["acts"][0]
        (state,) = policy["robots"][0]["states"]
        assert policy["sees"] and len(state["low"]) == len(state["high"]) == 6
        pixels = pixels_of(case, tmp_path)
        for index, view in enumerate(act["views"]):
            check_picture(seen.picture(act=1, view=index, **{"as": "seen"}), pixels[list(case.images).index(view["name"])])
    finally:
        seen.process.terminate()
        seen.process.communicate(timeout=SECONDS)
    other = Golden("one_view").bundle
    refused = subprocess.run([VLA, "replay", tmp_path / "r", "--bundle", other, "--page", "127.0.0.1:0"], capture_output=True, text=True, timeout=SECONDS)
    assert refused.returncode == 2 and "the recorded policy's bundle" in refused.stderr

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The client and `vla serve` itself."""

import io
import re
import signal
import subprocess
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from golden_cases import Golden
from PIL import Image
from server_process import SECONDS, VLA, Server, frames, ran

import vla_cpp


@pytest.fixture
def client(server):
    with vla_cpp.Client(server.address, timeout=SECONDS) as client:
        yield client


def observation(case, **changed):
    return {"images": frames(case), "state": case.state, "text": case.text, **changed}


def test_the_spec_is_what_the_bundle_says(client):
    spec = client.spec
    assert [v.name for v in spec.views] == ["observation.images.camera1", "observation.images.camera2"]
    assert [(s.name, s.width) for s in spec.states] == [("observation.state", 6)]
    assert (spec.horizon, spec.d_action, spec.d_noise, spec.noise) == (5, 7, 8, "normal")
    assert len(spec.action_names) == 7 and spec.bundle.arch == "smolvla"
    assert re.fullmatch("xxh3:[0-9a-f]{16}", spec.bundle.checksum)


def test_a_chunk_is_the_same_bytes_as_that_of_vla_run(client, case, tmp_path):
    for start, option in (({"seed": 7}, ("--seed", "7")), ({"noise": np.load(case.noise)}, ("--noise", case.noise))):
        chunk = client.act(**observation(case), **start)
        assert np.asarray(chunk).tobytes() == ran(case, tmp_path, *option).tobytes()
        assert chunk.seed == start.get("seed")


def test_raw_rows_and_a_png_file_of_a_frame_give_the_same_bytes(client, case):
    raw = client.act(**observation(case), seed=1)
    files = {view: file.read_bytes() for view, file in case.images.items()}
    mixed = {view: (frames(case) if i else files)[view] for i, view in enumerate(files)}
    for images in (files, mixed):
        assert np.asarray(client.act(**observation(case, images=images), seed=1)).tobytes() == raw.actions.tobytes()


def test_a_jpeg_file_is_decoded_by_the_server(client, case):
    def jpeg(frame):
        data = io.BytesIO()
        Image.fromarray(frame).save(data, "JPEG", quality=95)
        return data.getvalue()

    files = {view: jpeg(frame) for view, frame in frames(case).items()}
    pixels = {view: np.asarray(Image.open(io.BytesIO(data))) for view, data in files.items()}
    from_files = client.act(**observation(case, images=files), seed=1)
    from_pixels = client.act(**observation(case, images=pixels), seed=1)
    assert np.allclose(from_files, from_pixels, atol=0.05) and from_files.timing["decode"] > 0


def test_without_seed_and_noise_the_server_draws_a_seed_that_repeats_the_chunk(client, case):
    first, second = client.act(**observation(case)), client.act(**observation(case))
    assert first.seed != second.seed
    assert client.act(**observation(case), seed=first.seed).actions.tobytes() == first.actions.tobytes()


def test_a_chunk_tells_names_times_and_where_it_comes_from(client, case):
    chunk = client.act(**observation(case), seed=1, capture_time_ns=123456789)
    assert chunk.names == client.spec.action_names and chunk.bundle == client.spec.bundle
    assert {"decode", "prefix", "steps"} <= set(chunk.timing) and chunk.queue_ms >= 0
    assert chunk.capture_time_ns == 123456789 and chunk.notes == ()


def test_absent_views_are_declared_as_none_and_may_be_left_out_where_optional(tmp_path):
    case = Golden("absent_view")
    server = Server(case)
    try:
        with vla_cpp.Client(server.address, timeout=SECONDS) as client:
            chunk = client.act(**observation(case), seed=3)
            assert chunk.actions.tobytes() == ran(case, tmp_path, "--seed", "3").tobytes()
            optional = {v.name.rsplit(".", 1)[-1] for v in client.spec.views if v.optional}
            fewer = {view: f for view, f in frames(case).items() if f is not None or view not in optional}
            assert client.act(**observation(case, images=fewer), seed=3).actions.tobytes() == chunk.actions.tobytes()
    finally:
        server.stop()


@pytest.mark.parametrize(
    "changed, where",
    [
        (dict(images={}), "camera"),
        (dict(images={"nowhere": np.zeros((8, 8, 3), np.uint8)}), "nowhere"),
        (dict(state=[0.0] * 5), "state"),
        (dict(state={"elsewhere": [0.0] * 6}), "elsewhere"),
        (dict(text=None), "text"),
        (dict(images={"camera1": b"\x89PNG\r\n\x1a\nbroken", "camera2": None}), "camera1"),
    ],
)
def test_what_the_policy_cannot_take_is_refused_by_name_and_the_next_act_is_served(client, case, changed, where):
    with pytest.raises(vla_cpp.BadObservation) as caught:
        client.act(**observation(case, **changed))
    assert where in str(caught.value) and caught.value.found
    assert len(client.act(**observation(case))) == 5


def test_an_empty_text_is_answered_with_a_note(client, case):
    answer = client.act(**observation(case, text="", seed=7))
    assert "instruction: empty" in answer.notes and len(answer) == 5


def test_too_long_a_text_is_too_large(client, case):
    with pytest.raises(vla_cpp.TooLarge):
        client.act(**observation(case, text="a" * 100_000))


def test_health_counts_what_was_served(client, case):
    before = client.health()
    client.act(**observation(case))
    after = client.health()
    assert before.ready and after.chunks_served == before.chunks_served + 1 and after.uptime_s > before.uptime_s


def test_of_many_waiting_observations_the_newest_has_a_chunk_and_the_others_a_chunk_or_superseded(client, case):
    client.act(**observation(case))
    waiting = [client.submit(**observation(case), seed=seed) for seed in range(30)]
    outcomes = []
    for seed, pending in enumerate(waiting):
        try:
            outcomes.append(pending.result().seed == seed)
        except vla_cpp.Superseded:
            outcomes.append(None)
    assert outcomes[-1] is True and False not in outcomes


def test_clients_at_the_same_time_each_get_their_own_chunks(server, case):
    expected, wrong = {}, []
    with vla_cpp.Client(server.address, timeout=SECONDS) as client:
        for seed in range(8):
            expected[seed] = client.act(**observation(case), seed=seed).actions.tobytes()

    def work(seed):
        with vla_cpp.Client(server.address, timeout=SECONDS) as client:
            for _ in range(25):
                if client.act(**observation(case), seed=seed).actions.tobytes() != expected[seed]:
                    wrong.append(seed)

    threads = [threading.Thread(target=work, args=(seed,)) for seed in expected]
    [t.start() for t in threads]
    [t.join() for t in threads]
    assert wrong == []


def test_a_server_that_is_killed_costs_each_client_a_typed_error_and_no_more(case):
    server = Server(case)
    served, halted, asked, restarted = (threading.Barrier(9, timeout=SECONDS) for _ in range(4))

    def work(_):
        with vla_cpp.Client(server.address, timeout=SECONDS) as client:
            client.act(**observation(case))
            served.wait()
            halted.wait()
            pending = client.submit(**observation(case))
            asked.wait()
            start = time.monotonic()
            with pytest.raises(vla_cpp.Disconnected):
                pending.result()
            seconds = time.monotonic() - start
            restarted.wait()
            return seconds, len(client.act(**observation(case)))

    with ThreadPoolExecutor(8) as clients:
        outcomes = [clients.submit(work, i) for i in range(8)]
        served.wait()
        server.process.send_signal(signal.SIGSTOP)  # so that all eight wait for an answer when it dies
        halted.wait()
        asked.wait()
        server.stop(signal.SIGKILL)
        again = Server(case, address=server.address)
        restarted.wait()
        for outcome in outcomes:
            seconds, horizon = outcome.result()
            assert seconds < SECONDS / 4 and horizon == 5
    assert again.stop() == 0


def test_a_restart_between_two_acts_is_not_noticed_unless_other_weights_come_back(case):
    server = Server(case)
    with vla_cpp.Client(server.address, timeout=SECONDS) as client:
        first = client.act(**observation(case), seed=1)
        server.stop()
        again = Server(case, address=server.address)
        assert client.act(**observation(case), seed=1).actions.tobytes() == first.actions.tobytes()
        again.stop()
        other = Server(Golden("one_view"), address=server.address)
        for _ in range(2):
            with pytest.raises(vla_cpp.Incompatible, match="make a new Client"):
                client.act(**observation(case))
        other.stop()


def keys(folder, name):
    subprocess.run([VLA, "keygen", folder / name], check=True, capture_output=True)
    return folder / f"{name}.secret", folder / f"{name}.public"


def test_with_curve_a_listed_client_is_served_and_others_are_not(case, tmp_path):
    secret, public = keys(tmp_path, "server")
    robot_secret, robot_public = keys(tmp_path, "robot")
    stranger_secret, _ = keys(tmp_path, "stranger")
    server = Server(case, "--curve-secret", secret, "--curve-clients", robot_public)
    try:
        with vla_cpp.Client(server.address, timeout=SECONDS, server_key=public, secret_key=robot_secret) as client:
            assert client.act(**observation(case), seed=1).seed == 1
        text = robot_secret.read_text().strip()
        with vla_cpp.Client(
            server.address, timeout=SECONDS, server_key=public.read_text().strip(), secret_key=text
        ) as client:
            assert client.health().ready
        for wrong in (
            dict(server_key=public, secret_key=stranger_secret),
            dict(server_key=robot_public, secret_key=robot_secret),
            {},
        ):
            with vla_cpp.Client(server.address, timeout=2, **wrong) as client:
                with pytest.raises((vla_cpp.Disconnected, vla_cpp.Timeout)):
                    client.health()
    finally:
        server.stop()

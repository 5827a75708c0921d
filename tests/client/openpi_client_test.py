# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""`vla_cpp.OpenpiClient` at our own server and at one that has only the protocol."""

import contextlib
import json
import threading

import msgpack
import numpy as np
import pytest

pytest.importorskip("websockets")

from drop_in import openpi_array, pack, serving, unpack  # noqa: E402
from server_process import ROOT, SECONDS, frames, ran  # noqa: E402
from websockets.sync.server import serve  # noqa: E402

import vla_cpp  # noqa: E402
from vla_cpp.eval.cli import main  # noqa: E402


def lines_of(case):
    keys = {f"observation/{view.rsplit('.')[-1]}": view for view in frames(case)}
    return [f"{key}={view}" for key, view in keys.items()] + ["observation/state=observation.state"]


@pytest.fixture(scope="module")
def ours(case):
    options = [a for line in lines_of(case) for a in ("--map", line)]
    with serving(case, "--openpi", "127.0.0.1:0", "--max-message", "1", *options) as (_, address):
        yield address("ws://")


def observation(case):
    return {"images": frames(case), "state": {"observation.state": case.state}, "text": case.text}


@contextlib.contextmanager
def answering(answer, metadata=None):
    """A server of the protocol and nothing else: `answer` makes bytes, or text, of an observation."""

    def handle(connection):
        connection.send(pack({} if metadata is None else metadata, openpi_array))
        for message in connection:
            reply = answer(unpack(message))
            connection.send(reply)
            if isinstance(reply, str):
                connection.close(1011, "Internal server error. Traceback included in previous frame.")

    with serve(handle, "127.0.0.1", 0, compression=None) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"openpi://127.0.0.1:{server.socket.getsockname()[1]}"
        finally:
            server.shutdown()
            thread.join()


def chunk_bytes(seen):
    rows = np.arange(6, dtype=np.float64).reshape(2, 3) + np.asarray(seen["state"]).sum()
    return pack({"actions": rows, "policy_timing": {"infer_ms": 2.5}}, openpi_array)


def test_the_chunk_of_our_server_is_that_of_vla_run(case, ours, tmp_path):
    with vla_cpp.OpenpiClient(ours, [*lines_of(case), "prompt=text"], timeout=SECONDS) as policy:
        chunk = policy.act(**observation(case), seed=7)
        assert chunk.actions.tobytes() == ran(case, tmp_path, "--seed", "7").tobytes()
        assert chunk.seed == 7 and chunk.bundle.name == "bundle.gguf" and chunk.bundle.checksum.startswith("xxh3:")
        assert len(chunk.names) == chunk.actions.shape[1] and chunk.timing["infer"] > 0
        again = policy.act(**observation(case), seed=policy.act(**observation(case)).seed)
        assert again.actions.shape == chunk.actions.shape


def test_a_refusal_has_the_class_of_its_code_and_the_next_call_connects_again(case, ours):
    with vla_cpp.OpenpiClient(ours, [*lines_of(case), "prompt=text"], timeout=SECONDS) as policy:
        with pytest.raises(vla_cpp.BadObservation, match="observation.state"):
            policy.act(**{**observation(case), "state": {"observation.state": np.zeros(99)}})
        assert policy.act(**observation(case), seed=1).seed == 1


def test_names_must_cover_what_is_given_and_join_and_nest(case):
    seen = []
    lines = ["images/cam_high=top", "state=arm", "state=hand", "prompt=text"]
    with answering(lambda message: seen.append(message) or chunk_bytes(message)) as address:
        with vla_cpp.OpenpiClient(address, lines) as policy:
            state = {"arm": [1.0, 2.0], "hand": [0.5]}
            frame = np.full((4, 5, 3), 9, np.uint8)
            chunk = policy.act(images={"top": frame}, state=state, text="go")
            assert (seen[0]["images"]["cam_high"] == frame).all() and seen[0]["state"].tolist() == [1.0, 2.0, 0.5]
            assert seen[0]["prompt"] == "go" and "vla" not in seen[0]
            assert chunk.actions.dtype == np.float32 and chunk.actions[0].tolist() == [3.5, 4.5, 5.5]
            assert chunk.timing == {"infer": 2.5} and chunk.seed is None and not policy.takes_seeds
            with pytest.raises(vla_cpp.BadObservation, match="lines for each of arm, hand, top, wrist"):
                policy.act(images={"top": frame, "wrist": frame}, state=state, text="go")
            with pytest.raises(vla_cpp.Unsupported, match="seed"):
                policy.act(images={"top": frame}, state=state, text="go", seed=1)


def array_of(dtype="<f4"):
    return {"actions": {b"__ndarray__": True, b"data": bytes(24), b"dtype": dtype, b"shape": [2, 3]}}


@pytest.mark.parametrize(
    "reply, error, words",
    [
        ("Traceback (most recent call last):\n  ...\nKeyError: 'prompt'", vla_cpp.VlaError, "KeyError: 'prompt'"),
        ("late: deadline_ms: expected its turn", vla_cpp.Late, "its turn"),
        (msgpack.packb({"type": "error", "message": "no prompt"}), vla_cpp.VlaError, "no prompt"),
        (msgpack.packb({"chunk": 1}), vla_cpp.Incompatible, "chunk"),
        (b"\xc1", vla_cpp.Incompatible, "msgpack"),
        (b"\x91" * 5000, vla_cpp.Incompatible, "msgpack"),
        (msgpack.packb(array_of() | {"server_timing": 5}), vla_cpp.Incompatible, "actions"),
    ],
)
def test_what_is_no_chunk_is_a_typed_error(reply, error, words):
    with answering(lambda message: reply) as address, vla_cpp.OpenpiClient(
        address, ["state=arm", "prompt=text"]
    ) as policy:
        with pytest.raises(error, match=words) as raised:
            policy.act(images={}, state={"arm": [1.0]}, text="go")
        assert type(raised.value) is error


@pytest.mark.parametrize("dtype", ["|O", "<c8", "V8", "<f4,<f4"])
def test_arrays_of_objects_and_records_are_not_made(dtype):
    with answering(lambda message: msgpack.packb(array_of(dtype))) as address, vla_cpp.OpenpiClient(
        address, ["state=arm"]
    ) as policy:
        with pytest.raises(vla_cpp.Incompatible, match="an array of"):
            policy.act(images={}, state={"arm": [1.0]}, text="go")


def test_a_late_answer_is_a_timeout_and_not_the_answer_of_the_next_call():
    wait = threading.Event()

    def answer(message):
        if message["state"][0] == 1:
            wait.wait(SECONDS)
        return chunk_bytes(message)

    with answering(answer) as address, vla_cpp.OpenpiClient(
        address, ["state=arm", "prompt=text"], timeout=SECONDS
    ) as policy:
        with pytest.raises(vla_cpp.Timeout):
            policy.act(images={}, state={"arm": [1.0]}, text="go", timeout=0.2)
        assert policy.act(images={}, state={"arm": [5.0]}, text="go").actions[0, 0] == 5
        wait.set()
    with pytest.raises(vla_cpp.Disconnected, match="closed"):
        policy.act(images={}, state={"arm": [1.0]}, text="go")
    with pytest.raises(vla_cpp.Disconnected):
        vla_cpp.OpenpiClient(address, ["state=arm"])


def evaluate(tmp_path, capsys, address, *more):
    lines = ["observation/image=camera", "observation/state=state", "prompt=text"]
    names = [a for line in lines for a in ("--map", line)]
    out = ["--out", str(tmp_path / "run"), "--episodes", "2", "--quiet", "--json", "--workers", "1"]
    code = main(["null", "--server", address, *names, *out, *more])
    told = capsys.readouterr()
    return code, json.loads(told.out.strip().splitlines()[-1]) if code == 0 else told.err


class Shipped:
    bundle = ROOT / "models/metaworld-tiny.gguf"


def test_vla_eval_runs_the_same_episodes_at_our_server_again(tmp_path, capsys):
    options = ["--map", "observation/image=observation.images.corner4", "--map", "observation/state=observation.state"]
    with serving(Shipped, "--openpi", "127.0.0.1:0", *options) as (_, address):
        url = address("ws://").replace("ws://", "openpi://")
        runs = [evaluate(tmp_path / str(n), capsys, url)[1] for n in range(2)]
        with pytest.raises(SystemExit):
            evaluate(tmp_path / "late", capsys, url, "--latency-ms", "50")
    assert runs[0]["success"] == runs[1]["success"]
    assert runs[0]["run"]["a_identity"].startswith("xxh3:") and "openpi" in runs[0]["run"]["a"]


def test_vla_eval_runs_at_a_server_that_has_only_the_protocol(tmp_path, capsys):
    rows = np.full((10, 4), 0.1)
    with answering(lambda message: pack({"actions": rows}, openpi_array)) as address:
        data = evaluate(tmp_path, capsys, address)[1]
    assert data["success"]["drift"]["solved"] == 2 and "no seed fixes" in data["run"]["a"]
    code, told = evaluate(tmp_path / "gone", capsys, address)
    assert code == 9 and "expected an openpi server" in told

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""vla-export: what a server recorded comes back out of each format's own reader, to the bit."""

import io
import json
import random
import time

import numpy as np
import pytest
import xxhash
from PIL import Image
from server_process import SECONDS, Server, frames

import vla_cpp
from vla_cpp.export.cli import main
from vla_cpp.recording import _HEAD, _MAGIC, _SEAL, FILE, Recording, acts_of

FPS = 5


def _jpeg(frame):
    data = io.BytesIO()
    Image.fromarray(frame).save(data, "JPEG", quality=95)
    return data.getvalue()


@pytest.fixture(scope="module")
def recorded(case, tmp_path_factory):
    """Folder and acts of a robot: two instructions of three acts, one refused; pixels in one view, a JPEG in the other."""
    folder = tmp_path_factory.mktemp("recorded") / "recording"
    server = Server(case, "--record", folder)
    names = list(case.images)
    acts = []
    with vla_cpp.Client(server.address, timeout=SECONDS) as robot:
        for i in range(6):
            begun = time.monotonic()
            images = {name: np.roll(frame, i) for name, frame in frames(case).items()}
            images[names[1]] = _jpeg(images[names[1]])
            text = "open the drawer" if i < 3 else "close it"
            state = (np.asarray(case.state) + np.float32(i) / 7).astype(np.float32)
            acts.append((images, state, text, robot.act(images=images, state=state, text=text, seed=i, capture_time_ns=i + 1)))
            time.sleep(max(0, 1 / FPS - (time.monotonic() - begun)))
        with pytest.raises(vla_cpp.VlaError):
            robot.act(images=images, state=state)
    assert server.stop() == 0
    return folder, acts


def _full(name):
    return f"observation.images.{name.rsplit('.', 1)[-1]}"


def _upright(image):
    return image if isinstance(image, np.ndarray) else np.asarray(Image.open(io.BytesIO(image)))


def test_a_recording_has_what_was_sent_and_answered_with_its_times(recorded):
    folder, acts = recorded
    recording = Recording(folder)
    found = list(acts_of(recording))
    assert recording.is_whole and recording.spec.horizon == 5
    *answered, refused = found
    assert isinstance(refused.answer, vla_cpp.VlaError) and refused.answer.code == "bad_observation"
    for act, (images, state, text, chunk) in zip(answered, acts):
        assert act.text == text and act.answer.actions.tobytes() == chunk.actions.tobytes()
        assert act.states["observation.state"].tobytes() == state.tobytes()
        for name, image in images.items():
            kind, data = act.images[_full(name)]
            assert (kind, bytes(data)) == (("rgb", image.tobytes()) if isinstance(image, np.ndarray) else ("jpeg", image))
    times = [act.record.received_ns for act in found]
    assert times == sorted(times) and abs(times[-1] / 1e9 - time.time()) < 600
    assert np.median(np.diff(times[:-1])) / 1e9 == pytest.approx(1 / FPS, rel=0.25)
    assert len({act.record.client for act in found}) == 1


def test_mcap_reads_back_equal(recorded, tmp_path):
    reader = pytest.importorskip("mcap.reader")
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    folder, acts = recorded
    assert main([str(folder), "--mcap", str(tmp_path / "out.mcap")]) == 0
    topics = {}
    with open(tmp_path / "out.mcap", "rb") as file:
        opened = reader.make_reader(file, validate_crcs=True)
        for schema, channel, message in opened.iter_messages():
            if channel.message_encoding == "protobuf":  # as any reader does: by the schema in the file
                assert schema.name == "foxglove.CompressedImage"
                pool = descriptor_pool.DescriptorPool()
                for one in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
                    pool.AddSerializedFile(one.SerializeToString())
                kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
                value = kind.FromString(message.data)
                assert value.timestamp.ToNanoseconds() == message.log_time
            else:
                value = json.loads(message.data)
            topics.setdefault(channel.topic, []).append((message.log_time, value))
        (bundle,) = [record.metadata for record in opened.iter_metadata()]
    assert bundle["arch"] == "smolvla"
    for i, (images, state, text, chunk) in enumerate(acts):
        for name, image in images.items():
            at, message = topics["/" + _full(name).replace(".", "/")][i]
            assert message.format == ("png" if isinstance(image, np.ndarray) else "jpeg")
            assert np.array_equal(np.asarray(Image.open(io.BytesIO(message.data))), _upright(image))
        assert np.array_equal(np.float32(list(topics["/observation/state"][i][1].values())), state)
        assert topics["/instruction"][i] == (at, {"text": text})
        ready, action = topics["/action"][i]
        assert ready > at and action["seed"] == i and action["capture_time_ns"] == i + 1
        assert [list(row) for row in action["rows"]] == [list(chunk.names)] * len(chunk)
        assert np.array_equal(np.float32([list(row.values()) for row in action["rows"]]), chunk.actions)
        assert topics["/timing_ms"][i][1]["steps"] == chunk.timing["steps"]
    assert topics["/error"][0][1]["code"] == "bad_observation" and len(topics["/action"]) == len(acts)


def test_rerun_reads_back_equal(recorded, tmp_path):
    pytest.importorskip("rerun")
    from rerun.chunk import RrdReader

    folder, acts = recorded
    assert main([str(folder), "--rrd", str(tmp_path / "out.rrd")]) == 0
    columns = {}
    for chunk in RrdReader(tmp_path / "out.rrd").stream().to_chunks():
        rows = chunk.to_record_batch()
        for name in rows.schema.names:
            if not chunk.is_static and ":" in name:
                columns.setdefault(f"{chunk.entity_path}:{name}", []).extend(rows[name].to_pylist())
    for name in acts[0][0]:
        blobs = columns[f"/{_full(name).replace('.', '/')}:EncodedImage:blob"]
        for blob, act in zip(blobs, acts):
            assert np.array_equal(np.asarray(Image.open(io.BytesIO(bytes(blob[0])))), _upright(act[0][name]))
    assert np.array_equal(np.float32(columns["/observation/state:Scalars:scalars"]), [act[1] for act in acts])
    assert np.array_equal(np.float32(columns["/action:Scalars:scalars"]), [act[3].actions[0] for act in acts])
    assert [text for (text,) in columns["/instruction:TextDocument:text"]][:-1] == [act[2] for act in acts]


def test_lerobot_reads_back_equal(recorded, tmp_path):
    pytest.importorskip("lerobot")
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    folder, acts = recorded
    assert main([str(folder), "--lerobot", str(tmp_path / "data"), "--fps", str(FPS)]) == 0
    data = LeRobotDataset("data", root=tmp_path / "data")
    assert (data.num_episodes, data.num_frames, data.fps) == (2, len(acts), FPS)
    for frame, (images, state, text, chunk) in zip((data[i] for i in range(len(data))), acts):
        assert frame["task"] == text
        assert np.array_equal(frame["observation.state"], state)
        assert np.array_equal(frame["action"], chunk.actions[0]) and np.array_equal(frame["action_chunk"], chunk.actions)
        for name, image in images.items():
            pixels = (frame[_full(name)].numpy().transpose(1, 2, 0) * 255).round().astype(np.uint8)
            assert np.array_equal(pixels, _upright(image))


def test_a_data_set_of_another_rate_is_refused_and_leaves_nothing(recorded, tmp_path, capsys):
    pytest.importorskip("lerobot")
    assert main([str(recorded[0]), "--lerobot", str(tmp_path / "data"), "--fps", "50"]) == 2
    assert "the rate of the acts" in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_several_clients_are_told_apart(case, tmp_path, capsys):
    pytest.importorskip("mcap")
    server = Server(case, "--record", tmp_path / "recording")
    for _ in range(2):
        with vla_cpp.Client(server.address, timeout=SECONDS) as robot:
            robot.act(images=frames(case), state=case.state, text=case.text)
    assert server.stop() == 0
    arguments = [str(tmp_path / "recording"), "--mcap", str(tmp_path / "out.mcap")]
    assert main(arguments) == 2
    assert "several: 1 (1 acts), 2 (1 acts)" in capsys.readouterr().err
    assert main([*arguments, "--client", "3"]) == 2
    assert main([*arguments, "--client", "1", "--client", "2"]) == 0
    assert main([*arguments, "--client", "1"]) == 9 and "a name that is free" in capsys.readouterr().err


def test_a_damaged_recording_is_refused_wherever_the_damage_is(recorded, tmp_path, capsys):
    sound = (recorded[0] / FILE).read_bytes()
    draw = random.Random(1)
    for _ in range(200):
        damaged = bytearray(sound)
        damaged[draw.randrange(len(sound))] ^= 1 << draw.randrange(8)
        if draw.random() < 0.3:
            del damaged[draw.randrange(len(sound)) :]
        (tmp_path / FILE).write_bytes(damaged)
        with pytest.raises(vla_cpp.VlaError, match="requests.vlarec: record"):
            list(acts_of(Recording(tmp_path)))
    (tmp_path / FILE).write_bytes(sound[:-50])
    assert main([str(tmp_path), "--mcap", str(tmp_path / "out.mcap")]) == 11
    error = capsys.readouterr().err
    assert "--first" in error and not (tmp_path / "out.mcap").exists() and not (tmp_path / "out.mcap.part").exists()


def with_time(data, received_ns):
    """A recording whose first act came at another time, with a seal that fits."""
    at = len(_MAGIC)
    for _ in range(2):  # the description, and what is the first request
        begin = at
        head = list(_HEAD.unpack_from(data, at))
        at += _HEAD.size + _SEAL.size + head[2] + head[3]
    head[5] = received_ns
    sealed = _HEAD.pack(*head)
    rest = data[begin + _HEAD.size + _SEAL.size : at]
    digest = 0
    for part in (sealed, rest[: head[2]], rest[head[2] :]):
        digest = xxhash.xxh3_64_intdigest(part, digest)
    return data[:begin] + sealed + _SEAL.pack(digest) + rest + data[at:]


@pytest.mark.parametrize("received_ns", [2**64 - 1, 2**63, 4_102_444_800 * 10**9])
def test_a_time_that_no_format_can_hold_is_refused(recorded, tmp_path, capsys, received_ns):
    (tmp_path / FILE).write_bytes(with_time((recorded[0] / FILE).read_bytes(), received_ns))
    for option in (["--mcap", tmp_path / "x"], ["--rrd", tmp_path / "x"], ["--lerobot", tmp_path / "x", "--fps", "5"]):
        assert main([str(tmp_path), *map(str, option)]) == 11
        assert f"expected a time before the year 2100, found {received_ns} ns since 1970" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == [FILE]
    (tmp_path / FILE).write_bytes(with_time((recorded[0] / FILE).read_bytes(), received_ns % 10**18))
    assert main([str(tmp_path), "--mcap", str(tmp_path / "y")]) == 0


def test_what_an_export_that_was_killed_has_left_is_not_in_the_way(recorded, tmp_path):
    pytest.importorskip("pyarrow")
    (tmp_path / "x.part").mkdir()
    assert main([str(recorded[0]), "--lerobot", str(tmp_path / "x"), "--fps", "5"]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["x"]


def test_wrong_arguments_are_refused(recorded, tmp_path, capsys):
    folder = str(recorded[0])
    for arguments in ([], ["--lerobot", "x"], ["--mcap", "x", "--fps", "5"], ["--lerobot", "x", "--fps", "5", "--gap", "0"]):
        assert main([folder, *arguments]) == 2, arguments
    assert main([str(tmp_path), "--mcap", str(tmp_path / "x")]) == 9
    assert "requests.vlarec" in capsys.readouterr().err

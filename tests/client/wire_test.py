# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Messages: the descriptor that ships is that of the schema, and what is framed by hand is what protobuf would write."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from faulty_server import description
from google.protobuf import descriptor_pb2

from vla_cpp import wire

SCHEMA = Path(__file__).resolve().parents[2] / "src/wire/vla.proto"
SPEC, LIMITS = wire.spec_of(description()), wire.MESSAGES["Limits"]()


def parsed(**changed):
    arguments = dict(
        images={}, state=[1.0, 2.0], text="go", seed=None, noise=None, deadline_ms=10, capture_time_ns=None
    )
    data = wire.act_bytes(wire.new_request(9), SPEC, LIMITS, **{**arguments, **changed})
    return wire.Request.FromString(data)


def test_the_descriptor_of_the_package_is_that_of_the_schema(tmp_path):
    """To write it anew: protoc -I src/wire --descriptor_set_out=python/vla_cpp/vla.desc vla.proto"""
    if not shutil.which("protoc"):
        pytest.skip("protoc is not installed")
    out = tmp_path / "vla.desc"
    subprocess.run(["protoc", f"-I{SCHEMA.parent}", f"--descriptor_set_out={out}", SCHEMA.name], check=True)
    files = [descriptor_pb2.FileDescriptorSet.FromString(p.read_bytes()) for p in (out, wire.DESCRIPTOR)]
    assert files[0] == files[1]


@pytest.mark.parametrize("shape", [(1, 1), (1, 42), (6, 7), (43, 1), (73, 74), (256, 256), (480, 641)])
def test_a_raw_image_arg_any_size_arrives_as_it_was(shape):
    frame = np.random.default_rng(0).integers(0, 256, (*shape, 3), np.uint8)
    request = parsed(images={"top": frame, "wrist": None, "side": frame[::-1]}, seed=3)
    assert (request.protocol_version, request.request_id, request.act.seed) == (1, 9, 3)
    views = {view.name: view for view in request.act.views}
    assert len(request.act.views) == 3 and views["wrist"].WhichOneof("image") == "absent"
    for name, rows in (("top", frame), ("side", frame[::-1])):
        rgb = views[name].rgb
        assert (rgb.height, rgb.width) == shape and rgb.rows == rows.tobytes()


def test_an_observation_is_written_field_by_field():
    noise = np.arange(12, dtype=np.float32).reshape(4, 3)
    act = parsed(noise=noise, deadline_ms=0.4, capture_time_ns=-5, text="öffne").act
    assert act.states[0].name == "observation.state" and list(act.states[0].values) == [1, 2]
    assert (act.noise.horizon, act.noise.d_action, list(act.noise.values)) == (4, 3, noise.ravel().tolist())
    assert (act.deadline_ms, act.capture_time_ns, act.text) == (1, -5, "öffne")


def test_an_empty_instruction_is_on_the_wire_and_none_is_not():
    assert parsed(text="").act.HasField("text") and parsed(text="").act.text == ""
    assert not parsed(text=None).act.HasField("text")


@pytest.mark.parametrize(
    "changed",
    [
        dict(images=None),
        dict(images={3: None}),
        dict(images=[np.zeros((4, 4, 3), np.uint8)]),
        dict(text=5),
        dict(text=b"go"),
        dict(text="\ud800"),
        dict(deadline_ms=0),
        dict(deadline_ms=-1),
        dict(deadline_ms=float("nan")),
        dict(deadline_ms=1e300),
        dict(capture_time_ns=1.5),
        dict(capture_time_ns=2**63),
    ],
)
def test_what_no_message_can_hold_is_refused_by_its_name(changed):
    with pytest.raises((wire.BadObservation, wire.UsageError)) as caught:
        parsed(**changed)
    name = next(iter(changed))
    assert caught.value.where == {"text": "instruction"}.get(name, name)


def test_every_code_of_the_schema_has_an_exception_unless_it_is_never_sent():
    numbers = wire.MESSAGES["Error"].DESCRIPTOR.enum_types_by_name["Code"].values_by_name
    without = [
        name
        for name, value in numbers.items()
        if type(wire.exception_of(wire.MESSAGES["Error"](code=value.number))) is wire.VlaError
    ]
    assert sorted(without) == ["CODE_UNSPECIFIED", "MISMATCH"]

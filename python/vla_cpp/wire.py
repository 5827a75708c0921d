# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The messages of `vla serve`, to and from Python. docs/protocol.md and src/wire/vla.proto say what they mean.

The schema comes as a serialized descriptor (`vla.desc`), from which protobuf makes classes when this module is imported. Code that
protoc generates would tie the package to the releases of protobuf that accept that code; a descriptor is read by all of them.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Dict, Iterable, List, Mapping, Optional, Sequence, Tuple

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError

from .chunk import Chunk
from .errors import BadAction, BadObservation, Incompatible, TooLarge, UsageError, VlaError, error_of
from .observation import Image, Leftover, State, image_arg, leftover_of, named, noise_of, place, states_of
from .printable import printable
from .spec import BundleInfo, Spec, StateSpec, ViewSpec

PROTOCOL_VERSION = 1
DESCRIPTOR = Path(__file__).with_name("vla.desc")
MAX_PARTS = 1 << 16  # messages and texts of one answer
MAX_NOISE = 1 << 22  # numbers of one act's noise
_MOST = {"horizon": 1 << 16, "n_action_steps": 1 << 16, "noise_rows": 1 << 22, "d_noise": 1 << 16, "rate_hz": 1e6}  # numbers of a description


def _load_messages() -> Dict[str, Any]:
    """Message classes by name, in a pool of their own: another package may have a vla.v1 of another age."""
    files = descriptor_pb2.FileDescriptorSet.FromString(DESCRIPTOR.read_bytes())
    pool = descriptor_pool.DescriptorPool()
    for file in files.file:
        pool.AddSerializedFile(file.SerializeToString())
    if hasattr(message_factory, "GetMessageClass"):
        make = message_factory.GetMessageClass
    else:  # protobuf before 4.22
        make = message_factory.MessageFactory(pool).GetPrototype
    names = [message.name for file in files.file for message in file.message_type]
    return {name: make(pool.FindMessageTypeByName(f"vla.v1.{name}")) for name in names}


MESSAGES = _load_messages()
Request, Response = MESSAGES["Request"], MESSAGES["Response"]
_CODES = MESSAGES["Error"].DESCRIPTOR.enum_types_by_name["Code"].values_by_number


def new_request(request_id: int) -> Any:
    return Request(protocol_version=PROTOCOL_VERSION, request_id=request_id)


def act_bytes(
    request: Any,
    spec: Spec,
    limits: Any,
    *,
    images: Mapping[str, Image],
    state: State,
    text: Optional[str] = None,
    seed: Optional[int],
    noise: object,
    leftover: Optional[Leftover] = None,
    deadline_ms: float,
    capture_time_ns: Optional[int] = None,
) -> bytes:
    """A request with an observation, as bytes. Errors: BadObservation, UsageError, TooLarge, by the argument's name."""
    act = request.act
    act.SetInParent()
    raw: Dict[str, np.ndarray] = {}
    for name, image in named("images", images):
        kind, data = image_arg(place("view", name, spec.views), image)
        if kind == "rgb":
            raw[name] = np.asarray(data)
        elif kind == "absent":
            act.views.add(name=name).absent.SetInParent()
        else:
            setattr(act.views.add(name=name), kind, data)
    for name, values in states_of(state, spec.states).items():
        act.states.add(name=name).values.extend(values.tolist())
    if not isinstance(text, (str, type(None))):
        raise BadObservation("instruction", "a str", type(text).__name__)
    try:
        if text is not None:
            act.text = text
    except (ValueError, UnicodeError):
        raise BadObservation("instruction", "characters that UTF-8 can write", repr(text)[:80]) from None
    if noise is not None:
        values = noise_of(noise, spec.noise_rows, spec.d_noise)
        act.noise.horizon, act.noise.d_action = values.shape
        act.noise.values.extend(values.ravel().tolist())
    elif seed is not None:
        act.seed = int(seed)
    if leftover is not None:
        _add_leftover(act, leftover, leftover_of(leftover, spec))
    if spec.embodiment:
        act.embodiment = spec.embodiment
    act.deadline_ms = _milliseconds(deadline_ms)
    if capture_time_ns is not None:
        act.capture_time_ns = _int64("capture_time_ns", capture_time_ns)
    data = b"".join(_with_raw_images(request, raw))
    _check_limits(raw, len(data), limits, spec.views)
    return data


def _add_leftover(act: Any, leftover: Leftover, rows: np.ndarray) -> None:
    act.leftover.n_row, act.leftover.d_action = rows.shape
    act.leftover.values.extend(rows.ravel().tolist())
    act.leftover.delay = int(leftover.delay)
    if leftover.schedule is not None:
        act.leftover.schedule = leftover.schedule
    if leftover.max_guidance is not None:
        act.leftover.max_guidance = leftover.max_guidance


def _with_raw_images(request: Any, raw: Mapping[str, np.ndarray]) -> List[Any]:
    """The request's bytes in pieces, with the raw images appended to its act.

    They are framed here because protobuf would copy them twice into memory that is new each time, which takes longer than
    everything else that a client does. A repeated field may come in pieces, and a message's fields in any order.
    """
    views: List[Any] = []
    for name, rows in raw.items():
        rgb = MESSAGES["RawRgb"](height=rows.shape[0], width=rows.shape[1]).SerializeToString()
        rgb += _head("RawRgb", "rows", rows.nbytes)
        view = MESSAGES["View"](name=name).SerializeToString() + _head("View", "rgb", len(rgb) + rows.nbytes) + rgb
        views += [_head("Act", "views", len(view) + rows.nbytes) + view, rows.data.cast("B")]
    act = request.act.SerializeToString()
    envelope = Request(protocol_version=request.protocol_version, request_id=request.request_id).SerializeToString()
    return [envelope, _head("Request", "act", len(act) + sum(map(len, views))), act, *views]


def _head(message: str, field: str, size: int) -> bytes:
    """What stands before the `size` bytes of a field: its number with the wire type 2 (so many bytes), and their count."""
    head = bytearray([MESSAGES[message].DESCRIPTOR.fields_by_name[field].number << 3 | 2])
    while size > 0x7F:
        head.append(size & 0x7F | 0x80)
        size >>= 7
    head.append(size)
    return bytes(head)


def _milliseconds(value: float) -> int:
    if not 0 < value < 2**63:
        raise UsageError("deadline_ms", "milliseconds above 0", str(value))
    return math.ceil(value)


def _int64(where: str, value: int) -> int:
    if not isinstance(value, (int, np.integer)) or not -(2**63) <= value < 2**63:
        raise UsageError(where, "a whole number of 64 bits", repr(value))
    return int(value)


def _check_limits(raw: Mapping[str, np.ndarray], size: int, limits: Any, views: Sequence[ViewSpec]) -> None:
    """Refuses what the server would refuse; it would read all of a message that is too large before it says so."""
    for name, rows in raw.items():
        pixels = rows.shape[0] * rows.shape[1]
        if pixels > limits.max_pixels > 0:
            raise TooLarge(place("view", name, views), f"at most {limits.max_pixels} pixels", str(pixels))
    if size > limits.max_message_bytes > 0:
        hint = "send smaller frames, or JPEG; the server's option --max-message sets the limit"
        raise TooLarge("observation", f"at most {limits.max_message_bytes} bytes", str(size), hint)


def response_of(data: bytes) -> Any:
    """A Response. Errors: DecodeError, also for one of more than MAX_PARTS messages and texts: to read them would take seconds."""
    response = Response.FromString(data)
    _count(response, MAX_PARTS)
    return response


def _count(message: Any, left: int) -> int:
    """What is left of `left` after the repeated messages and texts of a message, and of those in it."""
    for _, value in message.ListFields():
        if hasattr(value, "ListFields"):
            left = _count(value, left)
        elif not isinstance(value, (str, bytes)) and hasattr(value, "__len__") and len(value):
            is_message = hasattr(value[0], "ListFields")
            left -= len(value) if is_message or isinstance(value[0], str) else 0
            if left < 0:
                raise DecodeError(f"more than {MAX_PARTS} parts")
            for part in value if is_message else ():
                left = _count(part, left)
    return left


def spec_of(description: Any) -> Spec:
    """Errors: Incompatible where a number is none of a policy."""
    for name, most in _MOST.items():
        value = getattr(description, name)
        if not 0 <= value <= most:  # which NaN is not either
            raise Incompatible("description", f"{name} from 0 to {most:g}", f"{value:g}")
    if description.noise_rows * description.d_noise > MAX_NOISE:
        raise Incompatible("description", f"noise of up to {MAX_NOISE} numbers", f"{description.noise_rows} x {description.d_noise}")
    runtime = description.runtime
    return Spec(
        views=tuple(
            ViewSpec(printable(v.name), v.optional, v.width, v.height, _texts(v.aliases), (v.camera_width, v.camera_height))
            for v in description.views
        ),
        min_views=description.min_views,
        states=tuple(
            StateSpec(
                printable(s.name), len(s.dimensions), _texts(d.unit for d in s.dimensions), _texts(d.name for d in s.dimensions)
            )
            for s in description.states
        ),
        action_names=_texts(d.name for d in description.actions),
        action_units=_texts(d.unit for d in description.actions),
        horizon=description.horizon,
        d_action=len(description.actions),
        d_noise=description.d_noise,
        noise_rows=description.noise_rows,
        noise=printable(description.noise_kind),
        real_time_chunking=printable(description.real_time_chunking),
        embodiment=printable(description.embodiment),
        robots={printable(robot.embodiment): spec_of(robot) for robot in description.embodiments},
        n_action_steps=description.n_action_steps,
        rate_hz=description.rate_hz,
        bundle=bundle_of(description.bundle),
        precision=printable(runtime.precision),
        kernels=printable(runtime.kernels),
        device=printable(runtime.device),
    )


def _texts(texts: Iterable[str]) -> Tuple[str, ...]:
    return tuple(map(printable, texts))


def bundle_of(bundle: Any) -> BundleInfo:
    source = bundle.source_name + (f"@{bundle.source_revision}" if bundle.source_revision else "")
    return BundleInfo(*map(printable, (bundle.name, bundle.arch, bundle.checksum, source)))


def chunk_of(message: Any) -> Chunk:
    """Errors: BadAction where the rows are not what the answer says of them."""
    actions = np.array(message.actions, np.float32)
    if actions.size != message.horizon * message.d_action or not actions.size:
        raise BadAction("answer", f"{message.horizon} x {message.d_action} actions", str(actions.size))
    normalized = np.array(message.normalized, np.float32)
    if normalized.size not in (0, actions.size):
        raise BadAction("answer", f"{actions.size} normalized numbers", str(normalized.size))
    return Chunk(
        actions=actions.reshape(message.horizon, message.d_action),
        names=_texts(message.names),
        rate_hz=message.rate_hz,
        bundle=bundle_of(message.bundle),
        timing={printable(stage.name): stage.ms for stage in message.stages},
        queue_ms=message.queue_ms,
        seed=message.seed if message.HasField("seed") else None,
        notes=_texts(message.notes),
        capture_time_ns=message.capture_time_ns or None,
        normalized=normalized.reshape(message.horizon, message.d_action) if normalized.size else None,
    )


def exception_of(error: Any) -> VlaError:
    known = _CODES.get(error.code)
    code = known.name.lower() if known else f"code_{error.code}"
    return error_of(code, *map(printable, (error.where, error.expected, error.found, error.hint)))

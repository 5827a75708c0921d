# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The messages of `vla serve`, to and from Python. docs/protocol.md and src/serve/vla.proto say what they mean.

The schema comes as a serialized descriptor (`vla.desc`), from which protobuf makes classes when this module is imported. Code that
protoc generates would tie the package to the releases of protobuf that accept that code; a descriptor is read by all of them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Dict, Optional

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from .chunk import Chunk
from .errors import BadAction, BadObservation, TooLarge, VlaError, error_of
from .observation import Image, State, noise_of, picture_of, states_of
from .spec import BundleInfo, Spec, StateSpec, ViewSpec

PROTOCOL_VERSION = 1
DESCRIPTOR = Path(__file__).with_name("vla.desc")


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


def fill_act(
    act: Any,
    spec: Spec,
    *,
    images: Dict[str, Image],
    state: State,
    text: str,
    seed: Optional[int],
    noise: object,
    deadline_ms: Optional[float],
    capture_time_ns: Optional[int],
) -> None:
    """Writes an observation into a message. Errors: BadObservation, by the argument's name."""
    for name, image in images.items():
        _fill_view(act.views.add(name=name), name, image)
    for name, values in states_of(state, spec.states).items():
        act.states.add(name=name).values.extend(values.tolist())
    if not isinstance(text, str):
        raise BadObservation("text", "a str", type(text).__name__)
    try:
        act.text = text
    except (ValueError, UnicodeError):
        raise BadObservation("text", "characters that UTF-8 can write", repr(text)[:80]) from None
    if seed is not None:
        act.seed = int(seed)
    if noise is not None:
        values = noise_of(noise, spec.horizon, spec.d_noise)
        act.noise.horizon, act.noise.d_action = values.shape
        act.noise.values.extend(values.ravel().tolist())
    if deadline_ms is not None:
        act.deadline_ms = max(1, int(deadline_ms))
    if capture_time_ns is not None:
        act.capture_time_ns = int(capture_time_ns)


def _fill_view(view: Any, name: str, image: Image) -> None:
    kind, data = picture_of(name, image)
    if kind == "absent":
        view.absent.SetInParent()
    elif kind == "rgb":
        view.rgb.height, view.rgb.width = data.shape[:2]
        view.rgb.rows = data.tobytes()
    else:
        setattr(view, kind, data)


def check_limits(act: Any, size: int, limits: Any) -> None:
    """Refuses what the server would refuse; it would end the connection over a message that is too large, and tell nothing."""
    for view in act.views:
        pixels = view.rgb.width * view.rgb.height
        if pixels > limits.max_pixels > 0:
            raise TooLarge(f'images["{view.name}"]', f"at most {limits.max_pixels} pixels", str(pixels))
    if size > limits.max_message_bytes > 0:
        hint = "send smaller frames, or JPEG; the server's option --max-message sets the limit"
        raise TooLarge("observation", f"at most {limits.max_message_bytes} bytes", str(size), hint)


def spec_of(description: Any) -> Spec:
    runtime = description.runtime
    return Spec(
        views=tuple(ViewSpec(v.name, v.optional, v.width, v.height, tuple(v.aliases)) for v in description.views),
        min_views=description.min_views,
        states=tuple(
            StateSpec(
                s.name, len(s.dimensions), tuple(d.unit for d in s.dimensions), tuple(d.name for d in s.dimensions)
            )
            for s in description.states
        ),
        action_names=tuple(d.name for d in description.actions),
        action_units=tuple(d.unit for d in description.actions),
        horizon=description.horizon,
        d_action=len(description.actions),
        d_noise=description.d_noise,
        noise=description.noise_kind,
        rate_hz=description.rate_hz,
        bundle=bundle_of(description.bundle),
        precision=runtime.precision,
        kernels=runtime.kernels,
        device=runtime.device,
    )


def bundle_of(bundle: Any) -> BundleInfo:
    source = bundle.source_name + (f"@{bundle.source_revision}" if bundle.source_revision else "")
    return BundleInfo(bundle.name, bundle.arch, bundle.checksum, source)


def chunk_of(message: Any) -> Chunk:
    """Errors: BadAction where the rows are not what the answer says of them."""
    actions = np.array(message.actions, np.float32)
    if actions.size != message.horizon * message.d_action or not actions.size:
        raise BadAction("answer", f"{message.horizon} x {message.d_action} actions", str(actions.size))
    if not np.isfinite(actions).all():
        raise BadAction("answer", "finite actions", "one that is not")
    return Chunk(
        actions=actions.reshape(message.horizon, message.d_action),
        names=tuple(message.names),
        rate_hz=message.rate_hz,
        bundle=bundle_of(message.bundle),
        timing={stage.name: stage.ms for stage in message.stages},
        queue_ms=message.queue_ms,
        seed=message.seed if message.HasField("seed") else None,
        notes=tuple(message.notes),
        capture_time_ns=message.capture_time_ns or None,
    )


def exception_of(error: Any) -> VlaError:
    known = _CODES.get(error.code)
    code = known.name.lower() if known else f"code_{error.code}"
    return error_of(code, error.where, error.expected, error.found, error.hint)

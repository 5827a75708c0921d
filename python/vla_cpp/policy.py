# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""A policy in this process, without a server: `spec`, `robot`, `act` and `close` as in `Client`."""

from __future__ import annotations

import ctypes
import os
import random
import threading
from typing import Any, List, Mapping, Optional, Sequence, Tuple, Type, Union

import numpy as np

from . import _capi
from .chunk import Chunk
from .errors import BadObservation, UsageError, VlaError, error_of
from .frozen import CameraWatch
from .handle import Handle, wrong_process
from .observation import (
    Image, Leftover, State, check_absent, check_start, image_arg, leftover_of, named, noise_of, place, robot_of, states_of, with_absent,
)  # fmt: skip
from .spec import BundleInfo, Spec, StateSpec, ViewSpec


class Policy(Handle):
    """A loaded bundle: `act` takes an observation and returns a chunk.

        with vla_cpp.Policy("policy.gguf") as policy:
            chunk = policy.act(images={"top": frame}, state=q, text="open the drawer")

    path     a bundle, as vla-convert makes it
    threads  number of CPU threads; 0: every core that the process may use
    kernels  "ggml", "portable", "neon", "neon_bf16", "avx2", "avx512", "avx512_bf16" or "amx"; "float32": the best that does not round to
             bf16; "bf16": the best that does, with large matrices rounded to bf16; "int8" or "int4": the best, with large matrices
             quantized, smaller and less exact. None: on the CPU the best for the bundle's dtype.
             Vulkan accepts None, "ggml" and "float32", which are the same, and "bf16". CUDA accepts None (matrices as they are stored),
             "float32", "bf16", "int8" and "int4" (large matrices converted), and "ggml"
    strict_state  refuse a state far outside the range of the training data (BadObservation) instead of answering with a note
    device   "cpu", "vulkan", "vulkan:1", "cuda", ...; None: "cpu". An absent device is a DeviceError, which lists the devices present
    embodiment  for a bundle for several robots: tag of the robot to load; None: all robots, and each `act` names its robot
    absent   views that the robot does not have, e.g. `["camera3"]`: no `act` needs to declare them, and none may give their image
    memory   limit in bytes of the process's memory, or on a GPU of the policy's GPU memory; 0: no limit. Matrices that do not fit stay in
             the file and are read in every act; actions are the same to the bit. A limit that is too low is an OutOfMemory, which says how
             many bytes suffice

    Threads may share a policy; their calls take turns, and other Python threads run meanwhile. A child process cannot use its parent's
    policy, since it does not inherit the compute threads. A policy cannot be pickled.

    Errors: IoError, BadBundle, Unsupported, OutOfMemory, DeviceError, UsageError.
    """

    def __init__(
        self,
        path: Union[str, os.PathLike],
        *,
        threads: int = 0,
        kernels: Optional[str] = None,
        strict_state: bool = False,
        device: Optional[str] = None,
        embodiment: Optional[str] = None,
        absent: Sequence[str] = (),
        memory: int = 0,
    ) -> None:
        self._handle = ctypes.c_void_p()
        self._lock = threading.Lock()
        self._pid = os.getpid()
        self._cameras = CameraWatch()
        self._library = _capi.load()
        if not isinstance(threads, int) or not 0 <= threads <= 512:
            raise UsageError("threads", "a whole number from 0 to 512", repr(threads))
        if not isinstance(memory, int) or not 0 <= memory < 1 << 64:
            raise UsageError("memory", "bytes, or 0 for no limit", repr(memory))
        options = _capi.Options(
            n_thread=threads,
            kernels=None if kernels is None else _encoded("kernels", kernels, UsageError),
            strict_state=bool(strict_state),
            device=None if device is None else _encoded("device", device, UsageError),
            embodiment=None if embodiment is None else _encoded("embodiment", embodiment, UsageError),
            memory=memory,
        )
        if self._library.vla_open(_path_of(path), options, ctypes.byref(self._handle)):
            raise self._last_error(None)
        self._spec = _spec_of(self._library.vla_describe(self._handle).contents)
        self._absent = check_absent(absent, self._spec)

    @property
    def spec(self) -> Spec:
        """The policy's inputs and outputs."""
        return self._spec

    def act(
        self,
        *,
        images: Mapping[str, Image],
        state: State,
        text: Optional[str] = None,
        seed: Optional[int] = None,
        noise: object = None,
        leftover: Optional[Leftover] = None,
        capture_time_ns: Optional[int] = None,
        embodiment: Optional[str] = None,
    ) -> Chunk:
        """One observation in, one action chunk out. The arguments are those of `Client.act`.

        Errors: BadObservation (names the input that the policy cannot accept), BadAction, DeviceError, OutOfMemory, InternalError.
        """
        check_start(seed, noise)
        if noise is None and seed is None:
            seed = random.SystemRandom().getrandbits(32)
        spec = robot_of(self._spec, embodiment)
        images = with_absent(images, self._absent, spec.views)
        call = _Call(spec, images, state, text, seed, noise, leftover)
        notes = self._cameras.notes(spec, images, state)
        with self._lock:
            self._check_usable()
            answer = ctypes.c_void_p()
            if self._library.vla_act(self._handle, call.observation, ctypes.byref(answer)):
                raise self._last_error(self._handle)
        try:
            return self._chunk_of(answer, spec, seed, capture_time_ns, notes)
        finally:
            self._library.vla_chunk_close(answer)

    def close(self) -> None:
        """Frees the policy, after waiting for a running call. A second call does nothing."""
        if os.getpid() != self._pid:
            return
        with self._lock:
            self._library.vla_policy_close(self._handle)
            self._handle = ctypes.c_void_p()

    def __del__(self) -> None:
        if getattr(self, "_library", None) is not None and os is not None:  # `os` is None while the interpreter exits
            self.close()

    def _check_usable(self) -> None:
        if os.getpid() != self._pid:
            raise wrong_process(self, "use in a child process")
        if not self._handle:
            raise UsageError("Policy", "an open policy", "one that was closed")

    def _last_error(self, handle: Optional[ctypes.c_void_p]) -> VlaError:
        error = self._library.vla_last_error(handle).contents
        return error_of(*(_text(getattr(error, part)) for part in ("code_name", "where", "expected", "found", "hint")))

    def _chunk_of(self, answer: ctypes.c_void_p, spec: Spec, seed: Optional[int], capture_time_ns: Optional[int], notes: Tuple[str, ...]) -> Chunk:
        lib = self._library
        actions, normalized = (
            np.ctypeslib.as_array(numbers(answer), (spec.horizon, spec.d_action)).copy()
            for numbers in (lib.vla_chunk_actions, lib.vla_chunk_normalized)
        )
        stages = range(lib.vla_chunk_n_stage(answer))
        return Chunk(
            actions=actions,
            names=spec.action_names,
            rate_hz=spec.rate_hz,
            bundle=spec.bundle,
            timing={_text(lib.vla_chunk_stage_name(answer, i)): lib.vla_chunk_stage_ms(answer, i) for i in stages},
            seed=None if seed is None else int(seed),
            notes=(*(_text(lib.vla_chunk_note(answer, i)) for i in range(lib.vla_chunk_n_note(answer))), *notes),
            capture_time_ns=capture_time_ns,
            normalized=normalized if spec.real_time_chunking else None,
        )


class _Call:
    """An observation as a struct of the library, together with the arrays that the struct points into."""

    def __init__(
        self,
        spec: Spec,
        images: Mapping[str, Image],
        state: State,
        text: Optional[str],
        seed: Optional[int],
        noise: object,
        leftover: Optional[Leftover],
    ) -> None:
        self._kept: List[Any] = []
        views = [self._view(name, image, place("view", name, spec.views)) for name, image in named("images", images)]
        states = [
            _capi.State(name=_name_of("state", name), values=self._address(values), n_value=values.size)
            for name, values in states_of(state, spec.states).items()
        ]
        self._kept += [views, states]
        sentence = None if text is None else _encoded("instruction", text, BadObservation)
        self.observation = _capi.Observation(
            views=(_capi.View * len(views))(*views),
            n_view=len(views),
            states=(_capi.State * len(states))(*states),
            n_state=len(states),
            text=sentence,
            text_size=len(sentence or b""),
            has_seed=seed is not None,
            seed=0 if seed is None else int(seed),
        )
        if spec.embodiment:
            self.observation.embodiment = spec.embodiment.encode()
        if noise is not None:
            values = noise_of(noise, spec.noise_rows, spec.d_noise)
            self.observation.noise, self.observation.n_noise = self._address(values), values.size
        if leftover is not None:
            self._add_leftover(leftover, leftover_of(leftover, spec))

    def _add_leftover(self, leftover: Leftover, rows: np.ndarray) -> None:
        o = self.observation
        o.leftover, o.n_leftover, o.leftover_delay = self._address(rows), rows.size, int(leftover.delay)
        if leftover.schedule is not None:
            o.schedule = _name_of("leftover.schedule", leftover.schedule)
        o.max_guidance = leftover.max_guidance or 0.0

    def _view(self, name: str, image: Image, where: str) -> _capi.View:
        data = image_arg(where, image)[1]
        view = _capi.View(name=_name_of("images", name), kind=_capi.IMAGE_ABSENT)
        if isinstance(data, bytes):
            view.kind, data = _capi.IMAGE_FILE, np.frombuffer(data, np.uint8)
        elif data is not None:
            view.kind, (view.height, view.width) = _capi.IMAGE_RGB8, data.shape[:2]
        if data is not None:
            view.data, view.size = self._address(data), data.size
        return view

    def _address(self, array: np.ndarray) -> int:
        self._kept.append(array)
        return array.ctypes.data


def _encoded(where: str, text: object, refusal: Type[VlaError]) -> bytes:
    if not isinstance(text, str):
        raise refusal(where, "a str", type(text).__name__)
    try:
        return text.encode()
    except UnicodeError:
        raise refusal(where, "characters that UTF-8 can write", repr(text)[:80]) from None


def _name_of(where: str, name: object) -> bytes:
    """A name in UTF-8. Refuses a NUL, at which the library would cut the name."""
    data = _encoded(where, name, BadObservation)
    if b"\0" in data:
        raise BadObservation(where, "a name", repr(name)[:80])
    return data


def _path_of(path: Union[str, os.PathLike]) -> bytes:
    try:
        data = os.fsencode(path)
    except (TypeError, UnicodeError):
        data = b"\0"
    if b"\0" in data:
        raise UsageError("path", "a file name", repr(path)[:80])
    return data


def _text(data: bytes) -> str:
    return data.decode("utf-8", "replace")


def _texts(pointers: Any, count: int) -> Tuple[str, ...]:
    return tuple(_text(pointers[i]) for i in range(count))


def _spec_of(d: _capi.Description) -> Spec:
    views = [d.views[i].contents for i in range(d.n_view)]
    states = [d.states[i].contents for i in range(d.n_state)]
    robots = [_spec_of(_capi.Description.from_address(d.embodiments[i])) for i in range(d.n_embodiment)]
    source, revision = _text(d.source), _text(d.revision)
    return Spec(
        views=tuple(
            ViewSpec(_text(v.name), bool(v.optional), v.width, v.height, (_text(v.alias),) if v.alias else ())
            for v in views
        ),
        min_views=d.min_views,
        states=tuple(
            StateSpec(_text(s.name), s.width, _texts(s.units, s.width), _texts(s.number_names, s.width)) for s in states
        ),
        action_names=_texts(d.action_names, d.d_action),
        action_units=_texts(d.action_units, d.d_action),
        horizon=d.horizon,
        d_action=d.d_action,
        d_noise=d.d_noise,
        noise_rows=d.noise_rows,
        noise=_text(d.noise),
        real_time_chunking=_text(d.real_time_chunking),
        rate_hz=d.rate_hz,
        bundle=BundleInfo(
            os.path.basename(_text(d.bundle_path)),
            _text(d.arch),
            _text(d.checksum),
            source + (f"@{revision}" if revision else ""),
        ),
        precision=_text(d.precision),
        kernels=_text(d.kernels),
        device=_text(d.device),
        embodiment=_text(d.embodiment),
        robots={robot.embodiment: robot for robot in robots},
        n_action_steps=d.n_action_steps,
    )

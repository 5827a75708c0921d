# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""libvla.so by ctypes. include/vla/vla.h documents the structs and functions."""

from __future__ import annotations

import ctypes
import functools
import os
from ctypes import POINTER, c_char_p, c_double, c_float, c_int32, c_size_t, c_uint32, c_uint64, c_void_p
from pathlib import Path

from .errors import IoError, Unsupported
from .installed import PACKAGE, source_tree

ABI_VERSION = 1
IMAGE_ABSENT, IMAGE_RGB8, IMAGE_FILE = 1, 2, 3


class _Struct(ctypes.Structure):
    """A versioned struct: the first field is its size, which the constructor sets."""

    def __init__(self, **fields: object) -> None:
        super().__init__(ctypes.sizeof(self), **fields)


class Error(_Struct):
    _fields_ = [
        ("struct_size", c_size_t),
        ("code", c_int32),
        ("code_name", c_char_p),
        ("where", c_char_p),
        ("expected", c_char_p),
        ("found", c_char_p),
        ("hint", c_char_p),
        ("message", c_char_p),
    ]


class Options(_Struct):
    _fields_ = [
        ("struct_size", c_size_t),
        ("n_thread", c_int32),
        ("kernels", c_char_p),
        ("strict_state", c_int32),
        ("device", c_char_p),
        ("embodiment", c_char_p),
        ("memory", c_uint64),
    ]


class ViewInfo(_Struct):
    _fields_ = [
        ("struct_size", c_size_t),
        ("name", c_char_p),
        ("alias", c_char_p),
        ("optional", c_int32),
        ("width", c_int32),
        ("height", c_int32),
    ]


class StateInfo(_Struct):
    _fields_ = [
        ("struct_size", c_size_t),
        ("name", c_char_p),
        ("width", c_size_t),
        ("number_names", POINTER(c_char_p)),
        ("units", POINTER(c_char_p)),
    ]


class Description(_Struct):
    _fields_ = [
        ("struct_size", c_size_t),
        ("n_view", c_size_t),
        ("min_views", c_size_t),
        ("views", POINTER(POINTER(ViewInfo))),
        ("n_state", c_size_t),
        ("states", POINTER(POINTER(StateInfo))),
        ("max_text_tokens", c_size_t),
        ("horizon", c_size_t),
        ("d_action", c_size_t),
        ("action_names", POINTER(c_char_p)),
        ("action_units", POINTER(c_char_p)),
        ("rate_hz", c_double),
        ("d_noise", c_size_t),
        ("noise", c_char_p),
        ("bundle_path", c_char_p),
        ("arch", c_char_p),
        ("checksum", c_char_p),
        ("source", c_char_p),
        ("revision", c_char_p),
        ("converter", c_char_p),
        ("dtype", c_char_p),
        ("precision", c_char_p),
        ("kernels", c_char_p),
        ("device", c_char_p),
        ("memory_weights", c_uint64),
        ("memory_plan", c_uint64),
        ("memory_working", c_uint64),
        ("noise_rows", c_size_t),
        ("real_time_chunking", c_char_p),
        ("embodiment", c_char_p),
        ("n_embodiment", c_size_t),
        ("embodiments", POINTER(c_void_p)),  # pointers to Description
        ("n_action_steps", c_size_t),
    ]


class View(_Struct):
    _fields_ = [
        ("struct_size", c_size_t),
        ("name", c_char_p),
        ("kind", c_uint32),
        ("width", c_int32),
        ("height", c_int32),
        ("stride", c_size_t),
        ("data", c_void_p),
        ("size", c_size_t),
    ]


class State(_Struct):
    _fields_ = [("struct_size", c_size_t), ("name", c_char_p), ("values", c_void_p), ("n_value", c_size_t)]


class Observation(_Struct):
    _fields_ = [
        ("struct_size", c_size_t),
        ("views", POINTER(View)),
        ("n_view", c_size_t),
        ("states", POINTER(State)),
        ("n_state", c_size_t),
        ("text", c_char_p),
        ("text_size", c_size_t),
        ("noise", c_void_p),
        ("n_noise", c_size_t),
        ("has_seed", c_uint32),
        ("seed", c_uint64),
        ("leftover", c_void_p),
        ("n_leftover", c_size_t),
        ("leftover_delay", c_int32),
        ("schedule", c_char_p),
        ("max_guidance", c_double),
        ("embodiment", c_char_p),
    ]


# name -> (result, arguments); policies and chunks are opaque pointers
_FUNCTIONS = {
    "vla_abi_version": (c_uint32, []),
    "vla_last_error": (POINTER(Error), [c_void_p]),
    "vla_open": (c_int32, [c_char_p, POINTER(Options), POINTER(c_void_p)]),
    "vla_policy_close": (None, [c_void_p]),
    "vla_describe": (POINTER(Description), [c_void_p]),
    "vla_act": (c_int32, [c_void_p, POINTER(Observation), POINTER(c_void_p)]),
    "vla_chunk_close": (None, [c_void_p]),
    "vla_chunk_actions": (POINTER(c_float), [c_void_p]),
    "vla_chunk_normalized": (POINTER(c_float), [c_void_p]),
    "vla_chunk_n_note": (c_size_t, [c_void_p]),
    "vla_chunk_note": (c_char_p, [c_void_p, c_size_t]),
    "vla_chunk_n_stage": (c_size_t, [c_void_p]),
    "vla_chunk_stage_name": (c_char_p, [c_void_p, c_size_t]),
    "vla_chunk_stage_ms": (c_double, [c_void_p, c_size_t]),
}


def _candidates() -> list:
    """Paths to look for the library: VLA_LIBRARY alone if set; else this package (a wheel contains it) and the source tree's build."""
    told = os.environ.get("VLA_LIBRARY")
    if told:
        return [Path(told)]
    name, root = f"libvla.so.{ABI_VERSION}", source_tree()
    return [PACKAGE / "lib" / name, *([root / "build" / "cpu" / "lib" / name] if root else [])]


@functools.lru_cache(maxsize=None)
def load() -> ctypes.CDLL:
    """Loads the library, once. Errors: IoError where there is none, Unsupported for one of another version."""
    candidates = _candidates()
    path = next((p for p in candidates if p.is_file()), None)
    if path is None:
        how = "pip install ./python builds it" if source_tree() else "install the wheel again, which carries it"
        hint = how + ", or name it in the environment variable VLA_LIBRARY"
        raise IoError("libvla.so", " or ".join(map(str, candidates)), "no such file", hint)
    try:
        library = ctypes.CDLL(str(path))
        for name, (result, arguments) in _FUNCTIONS.items():
            function = getattr(library, name)
            function.restype, function.argtypes = result, arguments
    except (OSError, AttributeError) as error:
        raise IoError(str(path), "a library of vla.cpp", str(error)) from None
    version = library.vla_abi_version()
    if version != ABI_VERSION:
        raise Unsupported(
            str(path), f"binary interface {ABI_VERSION}", str(version), "install package and library together"
        )
    return library

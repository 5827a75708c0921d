# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Checks a caller's observation and converts it to one form."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Dict, Iterable, Mapping, Optional, Sequence, Tuple, Union

import numpy as np

from .errors import BadObservation, Unsupported, UsageError
from .spec import Spec, StateSpec, ViewSpec

Image = Union[np.ndarray, bytes, bytearray, memoryview, "PIL.Image.Image", None]  # noqa: F821 (Pillow is not needed)
State = Union[Mapping[str, object], Sequence[float], np.ndarray, float]

MAX_SEED = 2**64 - 1


@dataclass(frozen=True, eq=False)
class Leftover:
    """Real-time chunking: the rows of the previous chunk that are not executed yet, which the next chunk continues.

    rows          the last rows of the previous chunk's `normalized`
    delay         how many of them will have been executed when the next chunk arrives
    schedule      only for a guided policy (`Spec.real_time_chunking`): how the weight of the rows after the delay falls, "zeros",
                  "ones", "linear" or "exp"
    max_guidance  only for a guided policy: the largest weight of the guidance
    """

    rows: object
    delay: int
    schedule: Optional[str] = None
    max_guidance: Optional[float] = None


def named(where: str, mapping: Mapping[str, Any]) -> Iterable[Tuple[str, Any]]:
    """The items of a dict whose keys are texts. Errors: BadObservation for anything else."""
    if not isinstance(mapping, Mapping) or not all(isinstance(name, str) for name in mapping):
        raise BadObservation(where, "a dict by name", "None" if mapping is None else type(mapping).__name__)
    return mapping.items()


def robot_of(spec: Spec, embodiment: Optional[str]) -> Spec:
    """The spec of the robot with this tag, which is None for a policy with one robot. Errors: BadObservation, which lists the tags."""
    tags = tuple(spec.robots) or ((spec.embodiment,) if spec.embodiment else ())
    if embodiment in tags:
        return spec.robots.get(embodiment, spec)
    if embodiment is None and not spec.robots:
        return spec
    expected = "one of " + ", ".join(tags) if tags else "none, since the policy is for one robot, which it does not name"
    raise BadObservation("embodiment", expected, "none" if embodiment is None else str(embodiment)[:80])


def place(kind: str, given: str, features: Sequence[Union[ViewSpec, StateSpec]]) -> str:
    """The `where` of an error about a given name, as in the runtime: the feature's full name, or e.g. `view "x"` for an unknown one."""
    names = {f.name: (f.name, *getattr(f, "aliases", ())) for f in features}
    whole = [name for name, known in names.items() if given in known]
    part = [name for name, known in names.items() if given in (k.rsplit(".", 1)[-1] for k in known)]
    found = whole or part
    return found[0] if len(found) == 1 else f'{kind} "{given}"'


def check_absent(absent: Sequence[str], spec: Spec) -> Tuple[str, ...]:
    """Checks the names of views that a robot does not have. Errors: UsageError for a name that is not a view of the policy."""
    views = [view for robot in ([*spec.robots.values()] or [spec]) for view in robot.views]
    for name in absent:
        if place("view", name, views) not in [view.name for view in views]:
            raise UsageError("absent", "views of the policy: " + ", ".join(view.name for view in views), str(name))
    return tuple(absent)


def with_absent(images: Mapping[str, Image], absent: Sequence[str], views: Sequence[ViewSpec]) -> Mapping[str, Image]:
    """The images plus None for each absent view. Errors: BadObservation for an image of an absent view."""
    if not absent:
        return images
    places = {place("view", name, views) for name in absent} & {view.name for view in views}
    given = {place("view", name, views): image for name, image in named("images", images)}
    for where in places:
        if given.get(where) is not None:
            raise BadObservation(where, "no image: the view was declared absent", "an image")
    return {**images, **dict.fromkeys(places - set(given))}


def image_arg(where: str, image: Image) -> Tuple[str, Union[np.ndarray, bytes, None]]:
    """Checks an image: ("rgb", contiguous uint8 array (height, width, 3)), ("jpeg" or "png", the file's bytes), or ("absent", None)."""
    if image is None:
        return "absent", None
    if isinstance(image, (bytes, bytearray, memoryview)):
        data = bytes(image)
        if data.startswith(b"\xff\xd8\xff"):
            return "jpeg", data
        if data.startswith(b"\x89PNG\r\n\x1a\n"):
            return "png", data
        raise BadObservation(where, "the bytes of a JPEG or PNG file", f"{len(data)} bytes that start otherwise")
    if is_pillow(image):
        if image.mode != "RGB":
            raise BadObservation(where, "a picture of mode RGB", f"mode {image.mode}", 'image.convert("RGB")')
        image = np.asarray(image)
    if not isinstance(image, np.ndarray):
        raise BadObservation(where, "a uint8 array, a Pillow image, the bytes of a JPEG or PNG file, or None", type(image).__name__, _of_tensor(image))
    if image.dtype != np.uint8:
        raise BadObservation(where, "uint8 pixels", f"{image.dtype} of shape {image.shape}", _of_floats(image))
    if image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        hint = "image.transpose(1, 2, 0) puts the channels last" if _channels_first(image) else "rows first, channels last: RGB"
        raise BadObservation(where, "shape (height, width, 3)", str(image.shape), hint)
    return "rgb", np.ascontiguousarray(image)


def is_pillow(image: object) -> bool:
    """Whether it is a Pillow image. Does not import Pillow, which may be missing."""
    return hasattr(image, "getbands") and hasattr(image, "mode")


def _channels_first(image: Any) -> bool:
    return len(image.shape) == 3 and image.shape[0] == 3 and image.shape[2] != 3


def _of_tensor(image: object) -> str:
    if not hasattr(image, "numpy") or not hasattr(image, "shape"):
        return "numpy.asarray(image) of a picture, open(path, 'rb').read() of a file"
    if "float" not in str(getattr(image, "dtype", "")):
        return "image.permute(1, 2, 0).numpy()" if _channels_first(image) else "image.numpy()"
    turn = ".permute(1, 2, 0)" if _channels_first(image) else ""
    return f"for values in [0, 1], as LeRobot has them: (255 * image).round().byte(){turn}.numpy()"


def _of_floats(image: np.ndarray) -> str:
    if image.dtype.kind != "f":
        return "give 0 to 255, not 0 to 1"
    turn = ".transpose(1, 2, 0)" if _channels_first(image) else ""
    return f"for values in [0, 1], as LeRobot has them: (255 * image).round().astype(numpy.uint8){turn}"


def states_of(state: State, specs: Sequence[StateSpec]) -> Dict[str, np.ndarray]:
    """Float32 vectors by name. A single array is the policy's only state."""
    if isinstance(state, Mapping):
        return {str(name): floats(place("state", str(name), specs), values, 1) for name, values in state.items()}
    if len(specs) != 1:
        names = ", ".join(s.name for s in specs) or "none"
        raise BadObservation("state", f"a dict with {names}", type(state).__name__)
    return {specs[0].name: floats(specs[0].name, state, 1)}


def noise_of(noise: object, n_row: int, d_noise: int) -> np.ndarray:
    """The noise as float32 (n_row, d_noise); a leading batch dimension of 1, as in the reference, is removed."""
    values = floats("noise", noise, 2)
    if values.shape != (n_row, d_noise):
        raise BadObservation("noise", f"shape ({n_row}, {d_noise})", str(values.shape))
    return values


def leftover_of(leftover: Leftover, spec: Spec) -> np.ndarray:
    """The leftover's rows as float32 (row, d_action). The runtime checks the other fields."""
    if not isinstance(leftover, Leftover):
        raise UsageError("leftover", "a Leftover", type(leftover).__name__)
    if not spec.real_time_chunking:
        raise Unsupported("leftover", "a policy that goes on from the rows of its previous chunk", "one that does not")
    rows = floats("leftover", leftover.rows, 2)
    if rows.shape[1] != spec.d_action or not 1 <= len(rows) <= spec.horizon:
        raise BadObservation("leftover", f"1 to {spec.horizon} rows of {spec.d_action} numbers", f"shape {rows.shape}")
    if not isinstance(leftover.delay, (int, np.integer)) or not 0 <= leftover.delay <= len(rows):
        raise BadObservation("leftover.delay", f"0 to {len(rows)}, the rows that are left", repr(leftover.delay))
    for name, kind in (("schedule", str), ("max_guidance", (int, float))):
        value = getattr(leftover, name)
        if value is not None and not isinstance(value, kind):
            raise BadObservation(f"leftover.{name}", "text" if kind is str else "a number", repr(value))
    return rows


def floats(where: str, values: object, n_dim: int) -> np.ndarray:
    """Finite float32 of `n_dim` dimensions; a scalar becomes a vector of one number, and a leading batch dimension of 1 is removed."""
    try:
        given = np.asarray(values)
        # The conversion would parse text and objects, but a number in quotes is a mistake of the caller.
        if given.dtype.kind not in "fiub":
            raise TypeError
    except (TypeError, ValueError, RuntimeError):
        raise BadObservation(where, "numbers", type(values).__name__) from None
    with np.errstate(over="ignore"):
        array = given.astype(np.float32)
    if array.ndim == 0:
        array = array[None]
    if array.ndim == n_dim + 1 and array.shape[0] == 1:
        array = array[0]
    if array.ndim != n_dim:
        raise BadObservation(where, f"{n_dim} dimension{'s' if n_dim > 1 else ''}", f"shape {given.shape}")
    if not np.isfinite(array).all():
        at = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        where += f"[{at[0]}]" if n_dim == 1 else ""
        raise BadObservation(where, "finite float32 numbers", f"{given.reshape(array.shape)[at]} at {list(at)}")
    return np.ascontiguousarray(array)


def check_start(seed: Optional[int], noise: object) -> None:
    if seed is not None and noise is not None:
        raise UsageError("act", "seed= or noise=", "both")
    if seed is not None and not (
        isinstance(seed, (int, np.integer)) and not isinstance(seed, bool) and 0 <= seed <= MAX_SEED
    ):
        raise UsageError("seed", f"a whole number from 0 to {MAX_SEED}", repr(seed))

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""LeRobot's batch of tensors as the arguments of `vla_cpp.Policy.act`."""

from typing import Any

import numpy as np
import vla_cpp
from lerobot.utils.constants import OBS_STR
from torch import Tensor

from .configuration_vla_cpp import VlaCppConfig


def observations(batch: dict[str, Any], spec: vla_cpp.Spec, config: VlaCppConfig) -> list[dict[str, Any]]:
    """One dict of images, state and text for each row of the batch.

    batch  images float (batch, 3, height, width) in [0, 1] or uint8; states (batch, width); "task" a text or one for each row.
           Only the last of several time steps is looked at, as LeRobot's SmolVLA does (prepare_images, prepare_state)
    Errors: BadObservation, with the names that the bundle takes where a name is not one of them
    """
    named = {config.rename_map.get(key, key): value for key, value in batch.items()}
    values = {key: value for key, value in named.items() if _is_observation(key, value) and key not in config.ignore}
    views, states = _split(values, spec)
    n = len(next(iter(values.values()))) if values else 0
    texts = _texts(batch.get("task"), n)
    return [
        {
            "images": {key: image(key, views[key][i]) for key in views},
            "state": {key: states[key][i].float().cpu().numpy() for key in states},
            "text": texts[i],
        }
        for i in range(n)
    ]


def _is_observation(key: str, value: Any) -> bool:
    """Masks and tokens that other processors add are no observations of the robot's."""
    return key.startswith(f"{OBS_STR}.") and isinstance(value, Tensor) and not key.endswith(("_is_pad", "_padding_mask"))


def _split(values: dict[str, Tensor], spec: vla_cpp.Spec) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """(views, states), each with one time step."""
    view_names = {name for view in spec.views for name in (view.name, *view.aliases)}
    state_names = {state.name for state in spec.states}
    unknown = sorted(set(values) - view_names - state_names)
    if unknown:
        raise vla_cpp.BadObservation(
            unknown[0],
            "one of " + ", ".join(sorted(view_names | state_names)),
            "an observation that the bundle does not take; the batch has " + ", ".join(sorted(values)),
            f'--policy.rename_map=\'{{"{unknown[0]}": "NAME"}}\' or --policy.ignore=\'["{unknown[0]}"]\'',
        )
    views = {key: v[:, -1] if v.ndim == 5 else v for key, v in values.items() if key in view_names}
    states = {key: v[:, -1] if v.ndim == 3 else v for key, v in values.items() if key in state_names}
    return views, states


def image(key: str, values: Tensor) -> np.ndarray:
    """uint8 (height, width, 3), the very bytes that LeRobot divided by 255.

    values  (3, height, width) float in [0, 1], or uint8
    Errors: BadObservation where the values are no multiples of 1 / 255: a picture that was resized or normalized as floats would
    be rounded
    """
    array = values.cpu().numpy()
    if array.ndim != 3 or array.shape[0] != 3:
        raise vla_cpp.BadObservation(key, "shape (3, height, width)", str(array.shape))
    if array.dtype != np.uint8:
        scaled = array * np.float32(255)
        pixels = np.rint(scaled)
        if not np.isfinite(scaled).all() or pixels.min() < 0 or pixels.max() > 255 or np.abs(scaled - pixels).max() > 1e-3:
            hint = "give frames as the camera has them: the bundle resizes and normalizes by itself"
            raise vla_cpp.BadObservation(key, "whole numbers of 0 to 255, divided by 255", "other numbers", hint)
        array = pixels.astype(np.uint8)
    return np.ascontiguousarray(array.transpose(1, 2, 0))


def _texts(task: Any, n: int) -> list[str]:
    texts = [task] * n if isinstance(task, str) else list(task or [])
    if len(texts) != n or not all(isinstance(text, str) for text in texts):
        raise vla_cpp.BadObservation("task", f"a text, or {n} of them", repr(task)[:80])
    return texts

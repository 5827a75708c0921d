# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What the formats share: names, and pictures as files or as pixels."""

from __future__ import annotations

import io
from typing import Any, List, Sequence, Tuple

import numpy as np

from ..errors import BadRequest


def column_names(names: Sequence[str], width: int) -> List[str]:
    """Names of a vector's elements; their indices where the bundle has no name for each."""
    named = len(set(names)) == len(names) == width and all(names)
    return list(names) if named else [str(i) for i in range(width)]


def picture_file(image: Tuple[str, Any]) -> Tuple[str, bytes]:
    """("jpeg" or "png", the file). What came as a file stays as it was; pixels become a PNG, which loses nothing."""
    kind, data = image
    if kind != "rgb":
        return kind, data
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(data).save(buffer, "PNG", compress_level=1)
    return "png", buffer.getvalue()


def pixels(image: Tuple[str, Any]) -> np.ndarray:
    """uint8 (height, width, 3), as the policy saw it."""
    kind, data = image
    if kind == "rgb":
        return data
    from PIL import Image

    try:
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))
    except OSError as problem:
        raise BadRequest("a recorded image", f"a {kind} file", str(problem)) from None

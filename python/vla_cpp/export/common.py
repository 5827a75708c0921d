# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Functions that the export formats share: column names, and pictures as files or as pixels."""

from __future__ import annotations

import io
from typing import Any, List, Sequence, Tuple

import numpy as np

from ..errors import BadRequest


def column_names(names: Sequence[str], width: int) -> List[str]:
    """Names of a vector's elements; their indices if the names are not all present and distinct."""
    named = len(set(names)) == len(names) == width and all(names)
    return list(names) if named else [str(i) for i in range(width)]


def picture_file(image: Tuple[str, Any]) -> Tuple[str, bytes]:
    """("jpeg" or "png", the file). A recorded file is kept unchanged; pixels become a PNG, which is lossless."""
    kind, data = image
    if kind != "rgb":
        return kind, data
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(data).save(buffer, "PNG", compress_level=1)
    return "png", buffer.getvalue()


def pixels(image: Tuple[str, Any]) -> np.ndarray:
    """The decoded picture, uint8 (height, width, 3)."""
    kind, data = image
    if kind == "rgb":
        return data
    from PIL import Image

    try:
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))
    except OSError as problem:
        raise BadRequest("a recorded image", f"a {kind} file", str(problem)) from None

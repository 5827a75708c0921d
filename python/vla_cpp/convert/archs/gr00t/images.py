# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Images of GR00T N1.6 and N1.7: the processor's pipeline and the resulting size.

Reference: Isaac-GR00T gr00t/model/gr00t_n1d7/image_augmentations.py, which lerobot policies/groot/processor_groot.py
(_transform_n1_7_image_for_vlm_albumentations) equals.
"""

from __future__ import annotations

import math
from typing import List, NamedTuple, Tuple

from ...errors import Code, Problems, refuse
from ...section import Section
from .. import Options
from .robot import DOCS, PROCESSOR

# On bytes: the reference folds the rescaling by 1 / 255 into mean and std, which are then exact.
STANDARDIZE = {"op": "standardize", "mean": [0.5] * 3, "std": [0.5] * 3, "arithmetic": "float32_in_bytes"}
MAX_SIDE = 8192


class Images(NamedTuple):
    width: int
    height: int
    ops: List[dict]


class Area(NamedTuple):
    """The sides and areas of images that the backbone's image processor does not resize."""

    file: str  # the file that states them
    filter: str  # filter for resizing other images
    shortest: int  # smallest side of an image
    multiple: int  # a side is a multiple of this
    min_pixels: int
    max_pixels: int


def read_images(processor: Section, area: Area, options: Options, notes: List[str], problems: Problems) -> Images:
    """The image ops and the resulting size. `processor`: the members of processor_kwargs."""
    edge, fraction = _edge(processor), _fraction(processor)
    pad, camera_size = options.letterbox or processor.get("letter_box_transform") is True, options.camera_size
    width, height = _camera(camera_size, edge, pad)
    ops: List[dict] = [{"op": "square_pad"}] if pad else []
    smallest = {"op": "smallest_side", "size": edge, "filter": "opencv_area"}
    ops.append(smallest)
    width, height = _smallest_side(width, height, edge)
    if 0.0 < fraction < 1.0:
        ops += [{"op": "crop_fraction", "fraction": fraction}, smallest]
        width, height = _smallest_side(max(1, int(width * fraction)), max(1, int(height * fraction)), edge)
    held = held_size(width, height, area, "--camera-size", problems)
    if held != (width, height):
        if not pad:  # checks the aspect ratio, which the resize would hide
            ops.append({"op": "expect_size", "width": width, "height": height})
        ops.append({"op": "resize", "width": held[0], "height": held[1], "filter": area.filter})
    width, height = held
    ops += [{"op": "size", "width": width, "height": height}, STANDARDIZE]
    if not pad:
        notes.append(
            "images keep their aspect: those of {} become {}x{}, others are refused ({})".format(
                camera_size or "square cameras", width, height, DOCS
            )
        )
    return Images(width, height, ops)


def read_square_images(processor: Section, area: Area, options: Options, notes: List[str], problems: Problems) -> Images:
    """LeRobot's pipeline without albumentations: frames of any aspect ratio become squares, which are cropped and enlarged again."""
    if options.camera_size:
        raise refuse("--camera-size", "no such option", options.camera_size, "frames of any size become squares of this policy", Code.USAGE)
    target, edge = _pair(processor, "image_target_size"), _edge(processor)
    stated = processor.get("crop_fraction") is not None or processor.get("image_crop_size") is not None
    side = max(1, round(edge * _fraction(processor))) if stated else edge
    resize = {"op": "resize", "filter": "torch_bicubic_16bit"}
    pad = options.letterbox or processor.get("letter_box_transform") is True
    # The crop of everything is needed because a resize as the first op would end the pipeline.
    ops: List[dict] = [{"op": "square_pad"} if pad else {"op": "crop_fraction", "fraction": 1.0}, {**resize, "width": edge, "height": edge}]
    if side < edge:
        ops.append({"op": "crop_fraction", "fraction": (side + 0.5) / edge})
    if side != target:
        ops.append({**resize, "width": target, "height": target})
    width, height = held_size(target, target, area, PROCESSOR + ": image_target_size", problems)
    if width != target:
        ops.append({"op": "resize", "width": width, "height": height, "filter": area.filter})
    return Images(width, height, [*ops, {"op": "size", "width": width, "height": height}, STANDARDIZE])


def _pair(processor: Section, key: str) -> int:
    """The side of a square stated as [height, width]; 0 for null."""
    value = processor.get(key)
    if value is None:
        return 0
    if isinstance(value, list) and len(value) == 2 and value[0] == value[1] and type(value[0]) is int and 0 < value[0] <= MAX_SIDE:
        return value[0]
    processor.bad(key, "[side, side] or null", unsupported=True)
    return 0


def _edge(processor: Section) -> int:
    target = _pair(processor, "image_target_size")
    if processor.get("shortest_image_edge") is not None:
        return processor.count("shortest_image_edge", maximum=MAX_SIDE)
    if not target:
        processor.bad("image_target_size", "a size, since shortest_image_edge is null too")
    return target or 1


def _fraction(processor: Section) -> float:
    value = processor.get("crop_fraction")
    if value is not None:
        if isinstance(value, (int, float)) and not isinstance(value, bool) and 0 < value <= 1:
            return float(value)
        processor.bad("crop_fraction", "a number above 0 and up to 1, or null")
        return 1.0
    crop, target = _pair(processor, "image_crop_size"), _pair(processor, "image_target_size")
    if not crop or not target or crop > target:
        processor.bad("image_crop_size", "a size within image_target_size, since crop_fraction is null")
        return 1.0
    return crop / target


def _camera(given: str, edge: int, pad: bool) -> Tuple[int, int]:
    """Width and height of the pipeline's input images; only their aspect ratio matters."""
    if not given or pad:
        return edge, edge
    parts = given.lower().split("x")
    if len(parts) == 2 and all(part.isdigit() and 0 < int(part) <= MAX_SIDE for part in parts):
        return int(parts[0]), int(parts[1])
    raise refuse("--camera-size", "WIDTHxHEIGHT in pixels, such as 640x480", given, code=Code.USAGE)


def _smallest_side(width: int, height: int, edge: int) -> Tuple[int, int]:
    scale = edge / float(min(width, height))
    if scale == 1:
        return width, height
    return max(1, int(round(width * scale))), max(1, int(round(height * scale)))


def held_size(width: int, height: int, area: Area, where: str, problems: Problems) -> Tuple[int, int]:
    """The size to which the backbone's image processor resizes an image (smart_resize). `where`: source of the size, for errors."""
    unit = area.multiple
    sides = [max(area.shortest, round(side / unit) * unit) for side in (width, height)]
    size = sides[0] * sides[1]
    if size > area.max_pixels:
        shrink = math.sqrt(width * height / area.max_pixels)
        sides = [max(unit, math.floor(side / shrink / unit) * unit) for side in (width, height)]
    elif size < area.min_pixels:
        grow = math.sqrt(area.min_pixels / (width * height))
        sides = [math.ceil(side * grow / unit) * unit for side in (width, height)]
    if max(width, height) > 200 * min(width, height) or max(sides) > MAX_SIDE:
        problems.unsupported(where, "images of at most 200 times the other side", "{}x{}".format(width, height))
    return sides[0], sides[1]

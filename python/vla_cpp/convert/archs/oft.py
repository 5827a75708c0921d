# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The common part of the policies of openvla-oft's trainer (BitVLA, OpenVLA-OFT, VLA-Adapter): its files beside a language model, the image
ops of its evaluation, the statistics of a robot, and the action head.

Reference: moojink/openvla-oft (vla-scripts/finetune.py, experiments/robot/{openvla_utils,robot_utils}.py, prismatic/models/action_heads.py,
projectors.py).
"""

from __future__ import annotations

import os
import re
from typing import Callable, Dict, List, Sequence, Tuple

import numpy as np

from .. import recipe
from ..checkpoint import Checkpoint, Tensors
from ..errors import Problems
from ..files import member
from ..layers import Rows, linear, norm
from ..options import Option
from ..torch_file import read_torch

STATISTICS = "dataset_statistics.json"
HEAD, PROPRIO = "action_head.", "proprio_projector."
N_HEAD_LAYER = 2  # a literal of the action head
GRIPPER = 6  # column of LIBERO's gripper, from 0 (closed) to 1 (open); for LIBERO's simulator -1 means open
VIEWS, ALIASES = ("image", "image2"), ("full_image", "wrist_image")  # names of LIBERO's cameras in LeRobot and in the reference
CROP, EPS, JPEG_QUALITY = 0.9, 1e-8, 95
PLAIN_IMAGES = Option("--plain-images", "images do not go through a JPEG of quality 95, as they do in the authors' evaluation", default=False)


def read_parts(folder: str, tensors: Tensors, required: Sequence[str], optional: Sequence[str], problems: Problems) -> None:
    """Adds the tensors of each part's file, with the part's name as prefix instead of DistributedDataParallel's."""
    steps: Dict[str, str] = {}
    for part in (*required, *optional):
        pattern = re.compile(re.escape(part) + r"--(?:(.+)_)?checkpoint\.pt")  # files on the hub may have no step
        found = {name: match[1] or "" for name in sorted(os.listdir(folder)) for match in [pattern.fullmatch(name)] if match}
        if not found and part in optional:
            continue
        if len(found) != 1:
            hint = "the reference loads the only one" if found else "download it beside config.json"
            problems.add("{}--STEP_checkpoint.pt".format(part), "one such file", ", ".join(found) or "none", hint)
            continue
        ((name, steps[part]),) = found.items()
        for stored, entry in read_torch(os.path.join(folder, name), "").items():
            own = "{}.{}".format(part, stored[len("module.") :] if stored.startswith("module.") else stored)
            if own in tensors[0]:
                problems.add("tensor " + own, "one tensor of this name", "a second one in " + name)
            tensors[0][own] = entry._replace(name=own)
    where, (first, *others) = "{}--{}_checkpoint.pt".format, list(steps) or [""]
    for part in others:
        if steps[part] != steps[first]:
            expected = "the step of " + where(first, steps[first])
            problems.add(where(part, steps[part]), expected, steps[part], "give the files of one step")


def dim(checkpoint: Checkpoint, name: str, axis: int, problems: Problems) -> int:
    """The length of a matrix along `axis`, which gives the width of a robot's state or action."""
    entry = checkpoint.tensors.get(name)
    if entry is not None and len(entry.shape) == 2:
        return entry.shape[axis]
    problems.add("tensor " + name, "a matrix", "none" if entry is None else str(entry.shape))
    return 0


def ranges(
    stated: dict, where: str, widths: Dict[str, int], names: Tuple[str, str], problems: Problems
) -> Tuple[Dict[str, np.ndarray], List[bool]]:
    """The statistics `names`, in float64 as in the reference, and which columns of an action are normalized. `widths`: by feature; 0 if the
    policy does not have the feature."""
    tensors: Dict[str, np.ndarray] = {}
    for feature, key in ((recipe.STATE, "proprio"), (recipe.ACTION, "action")):
        for name in names if widths[feature] else ():
            values = member(stated, key, dict, where).get(name)
            sound = isinstance(values, list) and all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in values)
            numbers = np.asarray(values if sound else [], np.float64)
            if numbers.shape != (widths[feature],) or not np.isfinite(numbers).all():
                problems.add("{}.{}.{}".format(where, key, name), "{} finite numbers".format(widths[feature]), str(values)[:80])
            tensors["stats.{}.{}".format(feature, name)] = numbers
    mask, n = member(stated, "action", dict, where).get("mask", [True] * widths[recipe.ACTION]), widths[recipe.ACTION]
    if not isinstance(mask, list) or len(mask) != n or not all(isinstance(on, bool) for on in mask):
        problems.add(where + ".action.mask", "true or false for {} numbers".format(n), str(mask)[:80])
        mask = [True] * n
    n_state = widths[recipe.STATE]
    if n_state and member(stated, "proprio", dict, where).get("mask", [True] * n_state) != [True] * n_state:
        problems.unsupported(where + ".proprio.mask", "true for all numbers", str(stated["proprio"]["mask"])[:80])
    return tensors, mask


def image_ops(side: int, plain: bool) -> List[dict]:
    """The image ops, for the frames that a client of the reference gets. The client first passes them through JPEG (resize_image_for_policy),
    like the training data; `plain`: without this. LIBERO's frames must be rotated by 180 degrees before, as its clients do."""
    size = {"width": side, "height": side}
    return [
        *([] if plain else [{"op": "jpeg", "quality": JPEG_QUALITY}]),
        {"op": "lanczos3", **size},
        {"op": "crop_and_resize", "area": CROP, **size},
        {"op": "size", **size},
    ]


def state_ops(kind: str, d_state: int) -> List[dict]:
    return [
        {"op": "normalize", "stats": "stats." + recipe.STATE, "kind": kind, "eps": EPS},
        {"op": "clip", "low": -1.0, "high": 1.0},
        {"op": "pad", "size": d_state},
    ]


def action_ops(kind: str, mask: List[bool], moves_libero: bool) -> List[dict]:
    """The action ops. `moves_libero`: convert the gripper to the sign that LIBERO's simulator expects."""
    columns = [i for i, on in enumerate(mask) if on]
    gripper = [{"op": "affine", "columns": [GRIPPER], "scale": -2.0, "shift": 1.0}, {"op": "sign", "columns": [GRIPPER]}]
    return [
        {"op": "unnormalize", "stats": "stats." + recipe.ACTION, "kind": kind, "eps": EPS, "columns": columns},
        *(gripper if moves_libero else []),
    ]


def in_bf16(rows: Rows) -> Rows:
    """The rows with rounding to bfloat16: they are trained in float32, and the reference rounds them on loading."""
    return [row._replace(in_bf16=True) for row in rows]


def projector(target: str, source: str, d: int, d_in: int) -> Rows:
    """A projector of `d_in` numbers to a token."""
    return in_bf16(linear(target + "_in", source + "fc1", d, d_in) + linear(target + "_out", source + "fc2", d, d))


def head(
    source: str, d: int, d_action: int, n_layer: int = N_HEAD_LAYER, attention: Callable[[str, str], Rows] = lambda target, source: []
) -> Rows:
    """The MLP-ResNet with the prefix `source`, which ends in a dot. `attention`: rows of a block before its MLP, from the block's prefixes in
    bundle and checkpoint."""
    d_in = d_action * d
    rows = norm("head.in_norm", source + "layer_norm1", d_in) + linear("head.in", source + "fc1", d, d_in)
    for i in range(n_layer):
        target, block = "head.blk.{}.".format(i), "{}mlp_resnet_blocks.{}.".format(source, i)
        rows += attention(target, block) + norm(target + "norm", block + "ffn.0", d) + linear(target + "linear", block + "ffn.1", d, d)
    return in_bf16(rows + norm("head.out_norm", source + "layer_norm2", d) + linear("head.out", source + "fc2", d_action, d))

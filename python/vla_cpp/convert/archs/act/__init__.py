# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Converts checkpoints of ACT to keys and tensors of a bundle.

Reference: lerobot src/lerobot/policies/act (configuration_act.py, modeling_act.py, processor_act.py) and torchvision models/resnet.py.
"""

from __future__ import annotations

from typing import Dict, List

from ... import recipe
from ...checkpoint import Checkpoint
from ...errors import Problems
from ...features import robot_keys
from ...images import standardized
from ...lerobot import required_view_keys
from .. import Options, Plan
from .config import ENVIRONMENT, Sizes, read_sizes
from .mapping import dropped, hints, network_keys, weights


def plan(checkpoint: Checkpoint, options: Options, problems: Problems) -> Plan:
    s = read_sizes(checkpoint, options, problems)
    problems.raise_any()
    others = {**({ENVIRONMENT: "ENV"} if s.d_environment else {}), **dict.fromkeys(s.views, "VISUAL")}
    dims = {recipe.STATE: s.d_state, recipe.ACTION: s.d_action, ENVIRONMENT: s.d_environment, **dict.fromkeys(s.views, 3)}
    processors = recipe.read_processors(checkpoint, dims, options.identity_stats, problems, {}, others=others, reads_text=False)
    problems.raise_any()
    document, views = recipe_document(s, processors, problems), required_view_keys(checkpoint, s.views, processors, problems)
    widths = {recipe.STATE: s.d_state, **({ENVIRONMENT: s.d_environment} if s.d_environment else {}), recipe.ACTION: s.d_action}
    keys = [*network_keys(s), *robot_keys(views, widths, options.dataset_info, checkpoint.notes, problems, 0), recipe.recipe_key(document)]
    problems.raise_any()
    return Plan(keys, weights(s), dropped(s), processors.statistics(without=s.views), hints(s))


def recipe_document(s: Sizes, processors: recipe.Processors, problems: Problems) -> Dict[str, List[dict]]:
    """The recipe. The reference does not resize, so frames must have the data set's size. If the views' sizes differ, each frame is placed in
    the corner of an image of the largest size, and the network reads only the frame's part."""
    width, height = s.frame
    size = {"width": width, "height": height}
    several = len(set(s.frames)) > 1
    cameras = [{"view": i, "width": w, "height": h} for i, (w, h) in enumerate(s.frames)] if several else [size]
    states = [(recipe.STATE, processors.state)] + ([(ENVIRONMENT, processors.others[ENVIRONMENT])] if s.d_environment else [])
    return {
        "image": [
            *({"op": "camera_size", **camera} for camera in cameras),
            *([{"op": "canvas", **size}] if several else []),
            {"op": "size", **size},
            *standardized([(view, processors.others[view]) for view in s.views], problems),
        ],
        "text": [],
        "state": [{**op, **({"feature": name} if s.d_environment else {})} for name, norm in states for op in norm.op("normalize", name)],
        "action": processors.action.op("unnormalize", recipe.ACTION),
    }

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Converts checkpoints of Diffusion Policy to keys and tensors of a bundle.

Reference: lerobot src/lerobot/policies/diffusion (configuration_diffusion.py, modeling_diffusion.py, processor_diffusion.py),
torchvision models/resnet.py, and the schedulers of diffusers.
"""

from __future__ import annotations

from typing import Dict, List, Sequence

from ... import recipe
from ...bundle import Key
from ...checkpoint import Checkpoint
from ...errors import Problems
from ...features import feature_keys, states_of, views_of
from ...images import standardized
from ..act.config import ENVIRONMENT
from .. import Options, Plan
from .config import Sizes, read_sizes
from .mapping import dropped, hints, network_keys, weights


def plan(checkpoint: Checkpoint, options: Options, problems: Problems) -> Plan:
    s = read_sizes(checkpoint, options, problems)
    problems.raise_any()
    others = {**({ENVIRONMENT: "ENV"} if s.d_environment else {}), **dict.fromkeys(s.cameras, "VISUAL")}
    dims = {recipe.STATE: s.d_state, recipe.ACTION: s.d_action, ENVIRONMENT: s.d_environment, **dict.fromkeys(s.cameras, 3)}
    processors = recipe.read_processors(checkpoint, dims, options.identity_stats, problems, {}, others=others, reads_text=False)
    problems.raise_any()
    keys = [
        *network_keys(s),
        *view_keys(s, recipe.view_aliases(s.cameras, processors, checkpoint.notes, problems)),
        *state_keys(s, options.dataset_info, checkpoint.notes, problems),
        recipe.recipe_key(recipe_document(s, processors, problems)),
    ]
    problems.raise_any()
    told = "n_obs_steps: an observation has {} moments; what was k steps ago is named NAME@-k, and before the first the first stands"
    if s.n_moment > 1:
        checkpoint.notes.append(told.format(s.n_moment))
    return Plan(keys, weights(s), dropped(s), processors.statistics(without=s.cameras), hints(s))


def moments(s: Sizes, name: str) -> List[str]:
    """The feature's names at each moment, oldest first."""
    return ["{}@-{}".format(name, k) for k in range(s.n_moment - 1, 0, -1)] + [name]


def view_keys(s: Sizes, aliases: Sequence[str]) -> List[Key]:
    views = [view for camera in s.cameras for view in moments(s, camera)]
    names = [alias for of in aliases for alias in (moments(s, of) if of else [""] * s.n_moment)]
    sizes = [Key("observation.camera_sizes", "u32[]", [side for _ in views for side in s.frame])] if views else []
    return [*views_of(views, names, [0] * len(views), len(views)), *sizes, Key("action.n_action_steps", "u32", s.n_action_steps)]


def state_keys(s: Sizes, info_path: str, notes: List[str], problems: Problems) -> List[Key]:
    """Keys of the state features at each moment; their numbers have the names of the data set, which has one moment."""
    widths = {recipe.STATE: s.d_state, **({ENVIRONMENT: s.d_environment} if s.d_environment else {})}
    keys = {key.name: key for key in feature_keys(info_path, {**widths, recipe.ACTION: s.d_action}, notes, problems)}
    named, first, names = keys["observation.state_names"], 0, []
    for width in widths.values():
        own = list(zip(*(moments(s, name) for name in named.value[first : first + width])))
        names += [name for moment in own for name in moment]
        first += width
    keys["observation.state_names"] = named._replace(value=names)
    keys["observation.state_units"] = keys["observation.state_units"]._replace(value=[""] * len(names))
    states = {moment: width for feature, width in widths.items() for moment in moments(s, feature)}
    return [*states_of(states), Key("observation.max_text_tokens", "u32", 0), *keys.values()]


def recipe_document(s: Sizes, processors: recipe.Processors, problems: Problems) -> Dict[str, List[dict]]:
    """The recipe. The reference normalizes pixels before it resizes and crops them; the result is the same, since the weights of a resize sum
    to 1."""
    normalized = [(recipe.STATE, processors.state)] + ([(ENVIRONMENT, processors.others[ENVIRONMENT])] if s.d_environment else [])
    views = [(camera, processors.others[camera]) for camera in s.cameras for _ in range(s.n_moment)]
    rows = {"op": "rows", "first": s.n_moment - 1, "count": s.n_action_steps}
    return {
        "image": [*image_ops(s), *standardized(views, problems)],
        "text": [],
        "state": [
            {**op, "feature": moment} for name, norm in normalized for moment in moments(s, name) for op in norm.op("normalize", name)
        ],
        "action": [rows, *processors.action.op("unnormalize", recipe.ACTION)],
    }


def image_ops(s: Sizes) -> List[dict]:
    if not s.cameras:
        return []
    width, height = s.frame
    size = {"width": s.image[0], "height": s.image[1]}
    if s.resized is None:
        crop = [{"op": "center_crop", **size}] if s.image != s.frame else []
        return [{"op": "camera_size", "width": width, "height": height}, *crop, {"op": "size", **size}]
    resize = {"op": "resize_floats", "width": s.resized[0], "height": s.resized[1], "filter": "bilinear"}
    return [{**resize, "from_width": width, "from_height": height}, *([{"op": "crop_floats", **size}] if s.image != s.resized else [])]

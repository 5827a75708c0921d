# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The common part of LeRobot's GR00T checkpoints of all releases: steps of the pipelines, the base, and a robot whose states and actions are
one vector each, normalized by the statistics of a data set.

Reference: lerobot policies/groot/processor_groot.py and configuration_groot.py of 0.4.0 to 0.6.1.
"""

from __future__ import annotations

import os
from dataclasses import replace
from typing import Dict, List, NamedTuple, Sequence, Tuple

import numpy as np

from ... import recipe
from ...bundle import Key
from ...checkpoint import Checkpoint, read_statistic
from ...errors import Code, Problems, refuse
from ...features import robot_keys
from ...files import member, plain_name, read_json
from ...hub import HUB_FORM
from ...lerobot import listed_views, required_view_keys, vector_dim
from ...safetensors_file import read_safetensors
from ...section import Fixed, Section
from .. import Options
from .robot import Group, Robot

PREFIX = "_groot_model."
CONFIG, PRE, POST = "config.json", recipe.PRE, recipe.POST
RENAME, BATCH, DEVICE = "rename_observations_processor", "to_batch_processor", "device_processor"
OTHERS = {  # steps that identify unsupported kinds of training -> the reason
    "groot_action_unpack_unnormalize_v1": "a step of N1.5, at which LeRobot stops beside the steps of N1.7",
    "relative_actions_processor": "its actions are made relative outside of GR00T's own statistics",
}
CONFIG_FIXED: Fixed = {"n_obs_steps": (1, 1), "lora_rank": (0, 0), "use_peft": (False, False)}
# Keys of training, of the machine and of the hub, and keys that the steps repeat.
CONFIG_IGNORED = set(
    """type input_features output_features device use_amp push_to_hub repo_id private tags license pretrained_path pretrained_revision
    chunk_size n_action_steps max_state_dim max_action_dim normalization_mapping base_model_path embodiment_tag tune_llm tune_visual
    tune_projector tune_diffusion_model tune_vlln tune_top_llm_layers num_inference_timesteps rtc_ramp_rate use_flash_attention
    use_relative_actions relative_exclude_joints optimizer_lr optimizer_betas optimizer_eps optimizer_weight_decay warmup_ratio use_bf16
    model_params_fp32 image_size tokenizer_assets_repo lora_alpha lora_dropout lora_full_model video_backend balance_dataset_weights
    balance_trajectory_weights dataset_paths output_dir save_steps max_steps batch_size dataloader_num_workers report_to resume
    action_decode_transform rtc_config""".split()
)
KIND = "groot_n1_5_min_max"  # a column with equal min and max is normalized to 0, and unnormalized to that number
IMAGES = "observation.images."


class Step(NamedTuple):
    where: str
    config: dict
    state_file: str  # file of the step's statistics; "" without


class Vectors(NamedTuple):
    """A robot whose states and actions are one vector each."""

    config: dict  # LeRobot's config.json
    views: List[str]  # in the network's order
    state: Group
    action: Group
    index: int  # the robot's index in the weights
    n_row: int  # rows of a chunk; the network may have fewer

    def robot(self, horizon: int) -> Robot:
        return Robot(self.views, [self.state], [self.action], min(self.n_row, horizon))

    def keys(self, checkpoint: Checkpoint, n_row: int, options: Options, problems: Problems) -> List[Key]:
        """Keys of views, states and actions, with LeRobot's names."""
        dims = {recipe.STATE: self.state.width, recipe.ACTION: self.action.width}
        steps = self.config.get("n_action_steps")
        told = {"chunk_size": n_row, "n_action_steps": min(steps, n_row) if type(steps) is int else None}
        own = replace(checkpoint, config={**self.config, **told})
        return robot_keys(required_view_keys(own, self.views, recipe.Processors(), problems), dims, options.dataset_info, checkpoint.notes, problems)


def names_of(checkpoint: Checkpoint, index: int) -> List[str]:
    """Names of the steps of the first (0) or second (1) pipeline."""
    pipelines = checkpoint.processors
    if pipelines is None:
        raise refuse(checkpoint.path(PRE), "LeRobot's pipelines", "none", "save the policy with its processors", Code.UNSUPPORTED)
    steps = member(pipelines[index], "steps", list, (PRE, POST)[index])
    return [str(step.get("registry_name")) if isinstance(step, dict) else "None" for step in steps]


def read_steps(checkpoint: Checkpoint, before: Sequence[str], after: Sequence[Sequence[str]], problems: Problems) -> Dict[str, Step]:
    """The steps by name. `before`: the steps of the first pipeline. `after`: the permitted second pipelines. Errors: unsupported for other
    steps."""
    found: Dict[str, Step] = {}
    for i, (file, allowed) in enumerate(((PRE, [before]), (POST, after))):
        names = names_of(checkpoint, i)
        if names not in [list(one) for one in allowed]:
            other = next((why for name, why in OTHERS.items() if name in names), "")
            raise refuse(file + ": steps", " or ".join(", ".join(one) for one in allowed), ", ".join(names)[:300], other, Code.UNSUPPORTED)
        for name, step in zip(names, checkpoint.processors[i]["steps"]):
            where = "{}: {}".format(file, name)
            for key in sorted(set(step) - {"registry_name", "config", "state_file"}):
                problems.unsupported("{}: {}".format(where, key), "no such field", str(step[key])[:80])
            found[name] = Step(where, member(step, "config", dict, where), step.get("state_file") or "")
            if name == DEVICE:
                device = Section(where, found[name].config, {}, problems)
                device.refuse_unknown(recipe.DEVICE)
                if device.get("float_dtype") not in recipe.DEVICE["float_dtype"]:
                    device.bad("float_dtype", "None or 'float32'", unsupported=True)
    rename = found[RENAME]
    Section(rename.where, rename.config, {}, problems).refuse_unknown({"rename_map"})
    if rename.config.get("rename_map"):
        found_map = str(rename.config["rename_map"])[:120]
        problems.unsupported(rename.where + ": rename_map", "{}, since cameras are found by the checkpoint's names", found_map)
    return found


def section(step: Step, problems: Problems) -> Section:
    return Section(step.where, step.config, {}, problems)


def cameras(config: dict, notes: List[str], problems: Problems) -> List[str]:
    """The cameras in LeRobot's order, which is sorted by name."""
    policy = Section(CONFIG, config, {}, problems)
    views = listed_views(policy, lambda name, kind: notes.append("input feature {} ({}): not read by this policy".format(name, kind)))
    if not views or not all(view.startswith(IMAGES) for view in views):
        policy.bad("input_features", "VISUAL features whose names begin with " + IMAGES, ", ".join(views) or "none")
    return sorted(views)


def action_width(config: dict, step: Section) -> int:
    """Width of the action. LeRobot cuts the network's columns to the feature's width, then to env_action_dim if that is smaller."""
    width = vector_dim(Section(CONFIG, config, {}, step.problems), "output_features", recipe.ACTION, "ACTION")
    if step.count("env_action_dim", minimum=0) not in (0, width):
        step.bad("env_action_dim", "the {} numbers of the feature action, or 0".format(width), hint="LeRobot's factory and its pipelines differ")
    return width


def state_group(checkpoint: Checkpoint, config: dict, step: Step, clips: bool, problems: Problems) -> Group:
    """The state, with the width of its statistics, since LeRobot ignores the width in the feature."""
    low, high = statistics(checkpoint, step, recipe.STATE, problems)
    stated = member(config, "input_features", dict, CONFIG).get(recipe.STATE)
    shape = stated.get("shape") if isinstance(stated, dict) else None
    if isinstance(stated, dict) and shape != [low.size]:
        text = "{} has {} numbers, as its statistics do, and not the {} of config.json"
        checkpoint.notes.append(text.format(recipe.STATE, low.size, shape))
    return Group("state", low.size, KIND, low, high, clips)


def action_group(checkpoint: Checkpoint, step: Step, width: int, clips: bool, problems: Problems) -> Group:
    low, high = statistics(checkpoint, step, recipe.ACTION, problems)
    if low.size < width:
        problems.add("{}: {}".format(step.where, recipe.ACTION), "statistics of {} numbers, as config.json has".format(width), str(low.size))
    return Group("action", width, KIND, np.resize(low, width), np.resize(high, width), clips)


def statistics(checkpoint: Checkpoint, step: Step, feature: str, problems: Problems) -> Tuple[np.ndarray, np.ndarray]:
    """Smallest and largest numbers. Refuses a step without them: LeRobot does not normalize then, and the policy was saved before training."""
    where, found = "{}: statistics of {}".format(step.where, feature), []
    if not plain_name(step.state_file):
        problems.unsupported(where, "a file with them beside the JSON", repr(step.state_file), "save the policy after its training")
        return np.zeros(1, np.float32), np.zeros(1, np.float32)
    entries = read_safetensors(checkpoint.path(step.state_file)).entries
    for name in ("min", "max"):
        entry = entries.get("{}.{}".format(feature, name))
        values = read_statistic(entry) if entry is not None else np.zeros(0, np.float32)
        if values.ndim != 1 or not values.size or not np.isfinite(values).all():
            problems.unsupported("{}: {}".format(where, name), "one row of finite numbers", str(values.shape) if entry is not None else "none")
            values = np.zeros(1, np.float32)
        found.append(values)
    if found[0].size != found[1].size:
        problems.add(where, "as many least as largest numbers", "{} and {}".format(found[0].size, found[1].size))
        found[1] = found[0]
    return found[0], found[1]


def robot_index(pack: Section) -> int:
    """The robot's index. As in LeRobot, an unknown tag has the index 0, and without a stated table the table of the class applies."""
    tag, mapping = pack.get("embodiment_tag"), pack.get("embodiment_mapping")
    if not isinstance(tag, str):
        pack.bad("embodiment_tag", "a name")
    if not isinstance(mapping, dict) or type(mapping.get(tag, 0)) is not int:
        pack.bad("embodiment_mapping", "indices of robots", str(mapping)[:80])
        return 0
    return mapping.get(tag, 0)


def check_robot(options: Options, tag: str) -> Options:
    """The options with the policy's only robot. Errors: usage."""
    if options.embodiment not in ("", tag):
        raise refuse("--embodiment", "{}, the only robot of this policy".format(tag), options.embodiment, code=Code.USAGE)
    return options.replaced(embodiment=tag)


def refuse_options(options: Options, names: Dict[str, str]) -> None:
    """Refuses options. `names`: option -> why the policy does not need it. Errors: usage."""
    for name, instead in names.items():
        if getattr(options, name):
            raise refuse("--" + name.replace("_", "-"), "no such option", str(getattr(options, name)), instead, Code.USAGE)


def take_over(checkpoint: Checkpoint, arch: str, config: dict) -> None:
    """Changes the checkpoint to the authors' layout: sets the config and removes the prefix of all tensor names."""
    checkpoint.config, checkpoint.layout, n = config, arch, len(PREFIX)
    checkpoint.tensors = {name[n:]: entry._replace(name=name[n:]) for name, entry in checkpoint.tensors.items()}
    checkpoint.aliases = {name[n:]: other[n:] for name, other in checkpoint.aliases.items()}


def base_config(checkpoint: Checkpoint) -> dict:
    """The base's config.json, which states the sizes of the network. Errors: io."""
    path = os.path.join(checkpoint.base, CONFIG) if checkpoint.base else ""
    if os.path.isfile(path):
        return read_json(path)
    named = str(checkpoint.config.get("base_model_path"))[:100]
    hint = "--base DIR or {} with the config.json of {}".format(HUB_FORM, named)
    raise refuse(checkpoint.path(CONFIG), "the sizes of the network, which are those of the policy that was fine-tuned", "none", hint, Code.IO)

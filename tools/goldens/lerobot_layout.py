# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""config.json and both pipelines as LeRobot saves them, for the families that it trains."""

import math
from pathlib import Path

import numpy as np

from .files import write_json, write_safetensors

# Fields of config.json that no conversion and no inference reads.
COMMON = {"n_obs_steps": 1, "device": "cpu", "use_amp": False, "use_peft": False, "push_to_hub": False, "repo_id": None,
          "private": None, "tags": None, "license": None, "pretrained_path": None, "pretrained_revision": None}
IDENTITY = {"VISUAL": "IDENTITY"}


def feature(kind, *shape):
    return {"type": kind, "shape": list(shape)}


def features(views, d_state, d_action, empty=()):
    """(input features, output features).  views: name -> (height, width); d_state: 0 where a policy reads no state; empty: the views of the
    cameras that a policy adds."""
    state = {"observation.state": feature("STATE", d_state)} if d_state else {}
    shown = {f"observation.images.{v}": feature("VISUAL", 3, *size) for v, size in (*views.items(), *empty)}
    return state | shown, {"action": feature("ACTION", d_action)}


def empty_cameras(n, height, width):
    return [(f"empty_camera_{i}", (height, width)) for i in range(n)]


def normalizer(name, shown, norm_map):
    return name, {"eps": 1e-08, "features": shown, "norm_map": norm_map}


def device(float_dtype=None):
    return "device_processor", {"device": "cpu", "float_dtype": float_dtype}


def tokenizer(name, max_length, padding="max_length"):
    return "tokenizer_processor", {"max_length": max_length, "task_key": "task", "padding_side": "right", "padding": padding,
                                   "truncation": True, "tokenizer_name": name}


def rename(names):
    return "rename_observations_processor", {"rename_map": names}


def count(shape):
    return math.prod(shape)


BATCH = ("to_batch_processor", {})


def write_pipelines(folder, before, after, statistics):
    """before, after: lists of (registry name, config).  statistics: feature -> statistic -> numbers."""
    folder = Path(folder)
    numbers = {f"{f}.{k}": np.asarray(v, "<f4") for f, table in statistics.items() for k, v in sorted(table.items())}
    for name, steps in (("policy_preprocessor", before), ("policy_postprocessor", after)):
        out = []
        for i, (step, config) in enumerate(steps):
            out.append({"registry_name": step, "config": config})
            if step.endswith("normalizer_processor"):
                out[-1]["state_file"] = f"{name}_step_{i}_{step}.safetensors"
                write_safetensors(folder / out[-1]["state_file"], numbers)
        write_json(folder / f"{name}.json", {"name": name, "steps": out}, indent=2)

# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""OpenVLA: DINOv2 and SigLIP in parallel, and a Llama 2 that generates a token for each number of an action.

A checkpoint is a folder saved by transformers. config.json has the statistics of all data sets of the training; a fine-tune has its own in
dataset_statistics.json, which the authors' evaluation reads instead.

Reference: openvla prismatic/extern/hf (modeling_prismatic.py, processing_prismatic.py), experiments/robot/openvla_utils.py.
"""

from __future__ import annotations

import os
from typing import Dict, List, Tuple

import numpy as np

from ... import recipe
from ...ascii_bpe import check_undivided
from ...bundle import Key
from ...checkpoint import Checkpoint, Layout
from ...errors import Problems, refuse
from ...features import robot_keys, view_name, views_of
from ...files import member, read_json
from ...options import stats, views
from ...section import Fixed, Section
from ...tokenizer import TokenizerPlan, read_tokenizer
from .. import Options, Plan
from .mapping import WHERE, Sizes, dropped, network_keys, read_sizes, weights

STATISTICS, IMAGES, TOKENIZER, GENERATION = (
    "dataset_statistics.json",
    "preprocessor_config.json",
    "tokenizer_config.json",
    "generation_config.json",
)
VIEW, ALIAS = "image", "full_image"
QUESTION, ANSWER = "In: What action should the robot take to ", "?\nOut:"
EMPTY, EMPTY_ID = "\u2581", 29871  # the last token of every prompt, a blank without a word, and its id in Llama 2's vocabulary
MAX_TOKENS = 256  # tokens of a prompt; far above any instruction, since the reference truncates none
# Parameters of the authors' image functions, which a file may state beside the values that they derive from.
NORMALIZE = "tvf_normalize_params"
DERIVED = {"tvf_resize_params", "tvf_crop_params", NORMALIZE, "tvf_do_letterbox", "tvf_letterbox_fill"}
IMAGES_IGNORED = {"auto_map", "image_processor_type", "processor_class", "feature_extractor_type"}
IMAGES_FIXED: Fixed = {
    "use_fused_vision_backbone": (False, True),
    "image_resize_strategy": ("letterbox", "resize-naive"),
    "interpolations": (None, ["bicubic", "bicubic"]),
}
# Keys of generation_config.json without effect on the answer: the authors' call never samples.
GENERATION_IGNORED = {
    *("_from_model_config", "bos_token_id", "pad_token_id", "transformers_version", "do_sample", "temperature", "top_k", "top_p"),
    *("max_length", "max_new_tokens", "use_cache"),
}


def plan(checkpoint: Checkpoint, options: Options, problems: Problems) -> Plan:
    s = read_sizes(checkpoint, problems)
    statistics, mask = _statistics(checkpoint, options.stats, problems)
    s.d_action = len(mask)
    _check_generation(checkpoint, s, problems)
    pixels = read_pixels(checkpoint, s.dino.image_size, problems)
    tokenizer = read_tokenizer(checkpoint.folder, s.lm.n_vocab, problems, checkpoint.notes)
    problems.raise_any()
    empty = check_prompt(checkpoint, tokenizer, s, problems)
    chosen = list(options.views) or [VIEW]
    if len(chosen) != 1:
        problems.unsupported("--views", "one camera", ",".join(chosen), "the network reads one image")
    views_keys = views_of([view_name(chosen[0])], [view_name(ALIAS)] if chosen == [VIEW] else [""], [0], 1)
    keys = [
        *network_keys(s),
        *robot_keys(views_keys, {recipe.ACTION: s.d_action}, options.dataset_info, checkpoint.notes, problems, MAX_TOKENS),
        *tokenizer.keys,
        Key("tokenizer.suffix_ids", "u32[]", [empty]),
        recipe.recipe_key(_recipe(s.dino.image_size, mask)),
    ]
    problems.raise_any()
    return Plan(keys, weights(s, pixels), dropped(s), statistics)


def _recipe(side: int, mask: List[bool]) -> Dict[str, List[dict]]:
    return {
        "image": [{"op": "resize", "width": side, "height": side, "filter": "pillow_bicubic"}],
        "text": text_ops(),
        "state": [],
        "action": [
            {
                "op": "unnormalize",
                "kind": "openpi_quantiles",  # the formula is the same, with statistics in float64
                "eps": 0.0,
                "stats": "stats." + recipe.ACTION,
                "columns": [i for i, on in enumerate(mask) if on],
            }
        ],
    }


def text_ops() -> List[dict]:
    return [
        {"op": "lower"},
        {"op": "template", "text": QUESTION + "{instruction}" + ANSWER},
        {"op": "tokenize", "max_tokens": MAX_TOKENS, "truncate": "right"},
    ]


LAYOUT = Layout(
    "OpenVLA's authors",
    (stats("the data set whose statistics un-normalize actions (their unnorm_key), where there are several"), views("name of the camera")),
    model_types=("openvla",),
    keys=("timm_model_ids", "vision_backbone_id"),
)


def chosen_statistics(checkpoint: Checkpoint, name: str) -> Tuple[dict, str]:
    """The statistics of a data set, and their place: the fine-tune's own file if there is one, else config.json. Errors: bad_bundle."""
    own = os.path.exists(checkpoint.path(STATISTICS))
    everything = read_json(checkpoint.path(STATISTICS)) if own else member(checkpoint.config, "norm_stats", dict, WHERE)
    where = STATISTICS if own else WHERE + ": norm_stats"
    if name not in everything and (name or len(everything) != 1):
        hint = "--stats NAME, the data set of the robot that the policy is to move"
        raise refuse(where, "one of " + (", ".join(everything) or "several data sets"), name or str(len(everything)), hint)
    name = name or next(iter(everything))
    return member(everything, name, dict, where), "{}: {}".format(where, name)


def _statistics(checkpoint: Checkpoint, name: str, problems: Problems) -> Tuple[Dict[str, np.ndarray], List[bool]]:
    """The statistics, in float64 as in the reference, and which numbers of an action are unnormalized."""
    entry, where = chosen_statistics(checkpoint, name)
    stated = member(entry, "action", dict, where)
    where += ".action"
    out = {}
    for quantile in ("q01", "q99"):
        values = stated.get(quantile)
        sound = isinstance(values, list) and all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in values)
        out[quantile] = np.asarray(values if sound else [], np.float64)
        if not out[quantile].size or out[quantile].shape != out["q01"].shape or not np.isfinite(out[quantile]).all():
            problems.add("{}.{}".format(where, quantile), "a finite number for each of an action", str(values)[:80])
    n = max(len(out["q01"]), 1)
    mask = stated.get("mask", [True] * n)
    if not isinstance(mask, list) or len(mask) != n or not all(isinstance(on, bool) for on in mask):
        problems.add(where + ".mask", "true or false for {} numbers".format(n), str(mask)[:80])
        mask = [True] * n
    return {"stats.{}.{}".format(recipe.ACTION, quantile): values for quantile, values in out.items()}, mask


def _check_generation(checkpoint: Checkpoint, s: Sizes, problems: Problems) -> None:
    """Reads generation_config.json, whose stop token replaces the one in config.json."""
    if not os.path.exists(checkpoint.path(GENERATION)):
        return
    section = Section(GENERATION, read_json(checkpoint.path(GENERATION)), {}, problems)
    section.refuse_unknown({*GENERATION_IGNORED, "eos_token_id"})
    s.stop_token = section.count("eos_token_id", 0, s.lm.n_vocab - 1)


def read_pixels(checkpoint: Checkpoint, side: int, problems: Problems) -> List[Dict[str, tuple]]:
    """Mean and std of the pixels of each tower, in float32 as in torchvision. Derived parameters in the file replace the values that they would
    be derived from (transformers ImageProcessingMixin.__init__), as in VLA-Adapter's files."""
    images = Section(IMAGES, read_json(checkpoint.path(IMAGES)), {}, problems)
    images.check_fixed(IMAGES_FIXED)
    images.refuse_unknown({*IMAGES_FIXED, *IMAGES_IGNORED, *DERIVED, "input_sizes", "means", "stds"})
    if images.get("input_sizes") != [[3, side, side]] * 2:
        images.bad("input_sizes", "twice 3 x {0} x {0}, as config.json: image_sizes has it".format(side), unsupported=True)
    out = [_standard(images, i) for i in range(2)]
    resize = {"antialias": True, "interpolation": 3, "max_size": None, "size": [side, side]}
    derived = {
        "tvf_resize_params": [resize] * 2,
        "tvf_crop_params": [{"output_size": [side, side]}] * 2,
        "tvf_do_letterbox": False,
        "tvf_letterbox_fill": None,
    }
    for key, value in derived.items():
        if images.values.get(key, value) != value:
            images.bad(key, "{}, as the file's other keys make it".format(value), unsupported=True)
    if NORMALIZE not in images.values:
        return out
    stated = images.values[NORMALIZE]
    if (
        not isinstance(stated, list)
        or len(stated) != 2
        or not all(isinstance(own, dict) and {*own, "inplace"} == {"inplace", "mean", "std"} for own in stated)
    ):
        images.bad(NORMALIZE, "mean and std of two towers", str(stated)[:120], unsupported=True)
        return out
    rows = {key + "s": [own[key] for own in stated] for key in ("mean", "std")}
    return [_standard(Section("{}: {}".format(IMAGES, NORMALIZE), rows, {}, problems), i) for i in range(2)]


def _standard(images: Section, i: int) -> Dict[str, tuple]:
    numbers = {"mean": _channels(images, "means", i, -1e3), "std": _channels(images, "stds", i, 1e-3)}
    return {key: tuple(map(float, np.float32(values))) for key, values in numbers.items()}


def _channels(images: Section, key: str, i: int, above: float) -> List[float]:
    rows = images.get(key)
    row = rows[i] if isinstance(rows, list) and len(rows) == 2 else None
    if (
        isinstance(row, list)
        and len(row) == 3
        and all(isinstance(x, (int, float)) and not isinstance(x, bool) and above < x < 1e3 for x in row)
    ):
        return row
    if i == 0 or isinstance(rows, list):
        images.bad(key, "three numbers above {:g} for each of two towers".format(above))
    return [1.0] * 3


def check_prompt(checkpoint: Checkpoint, tokenizer: TokenizerPlan, s: Sizes, problems: Problems) -> int:
    """Checks that every prompt begins with one token, after which the image tokens come. Returns the id of the empty token."""
    config, keys = read_json(checkpoint.path(TOKENIZER)), {key.name: key.value for key in tokenizer.keys}
    if config.get("add_prefix_space") is not None:
        hint = "the reference then makes the tokenizer of tokenizer.model"
        problems.unsupported(TOKENIZER + ": add_prefix_space", "no such key", repr(config["add_prefix_space"]), hint)
    if keys.get("tokenizer.normalization") != "blank_first" or len(keys["tokenizer.prefix_ids"]) != 1:
        expected = "Llama 2's: a blank in front of every text, and one token"
        problems.unsupported("tokenizer.json: normalizer, post_processor", expected, str(keys.get("tokenizer.prefix_ids")))
    check_undivided(tokenizer.keys, (), [QUESTION, ANSWER], problems)
    found = tokenizer.tokens.index(EMPTY) if EMPTY in tokenizer.tokens else 0
    if not found or (s.lm.n_vocab > EMPTY_ID and found != EMPTY_ID):
        hint = "the reference puts this id behind every prompt"
        problems.add("tokenizer.json: model.vocab", "U+2581 as token {}".format(EMPTY_ID), str(found or "none"), hint)
    return found

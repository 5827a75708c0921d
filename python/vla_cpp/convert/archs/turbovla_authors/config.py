# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Reads the authors' files: model_config in the weights' file, statistics beside it, and the configs of both backbones. Refuses everything that
the runtime does not support.

An absent key has the default of turbovla/models/configuration.py, listed here with the key.
"""

from __future__ import annotations

import glob
import os
from dataclasses import dataclass
from typing import Dict, List, Sequence, Tuple

import numpy as np

from ... import recipe
from ...checkpoint import Checkpoint, Layout, Tensors, find_backbone
from ...errors import Code, Problems, refuse
from ...features import view_name
from ...files import member, read_json
from ...images import IMAGENET
from ...networks import MAX_LAYERS, TextEncoder, Vision, read_vision
from ...options import Option, stats, views
from ...section import Section
from ...torch_file import read_torch, read_torch_value
from .. import Options
from ..turbovla.config import DINOV3, TEXT, TEXT_FIXED, VISION, VISION_FIXED, read_bert

WEIGHTS = ("model_state_dict", "model", "state_dict")  # the first of these keys in a file is used (policy.py _checkpoint_state_dict)
CONFIG, STATISTICS = "model_config", "*stats*.json"
BACKBONE = "vision_encoder.backbone."
VIEWS, ALIASES = ("image", "image2"), ("full_image", "wrist_image")  # names of LIBERO's cameras in LeRobot and in the authors' clients
MIN_TOKENS = 2  # the tokens before and after every text

TEXT_ENCODER = {
    "model_name_or_path": "bert-base-uncased",
    "max_length": 256,
    "padding_length": None,
    "padding_length_by_instruction": {},
    "sub_sentence_present": True,
    "zero_padded_tokens": False,
}
VISION_ENCODER = {"image_size": 256, "num_views": 2, "position_embedding": "view"}
INTERACTION = {
    "hidden_dim": 256,
    "nheads": 8,
    "num_layers": 6,
    "dim_feedforward": 2048,
    "enhancer_inner_dim": 1024,
    "padding_strategy": "key_padding_mask",
    "residual_style": "normalized",
}
ACTION = {
    "action_dim": 7,
    "state_dim": 8,
    "horizon": 12,
    "num_state_tokens": 2,
    "num_layers": 3,
    "mlp_hidden_dim": 512,
    "state_hidden_dim": 256,
}
PARTS = {"text": TEXT_ENCODER, "vision": VISION_ENCODER, "interaction": INTERACTION, "action": ACTION}
# Keys without effect on the numbers of an action chunk in float32.
IGNORED = {
    "text": set("frozen force_eval_when_frozen local_files_only attention_implementation".split()),
    "vision": set(
        """
        model_name_or_path encode_views_separately frozen local_files_only attention_implementation compute_precision position_init_std
        position_scale_init dropout
        """.split()
    ),
    "interaction": set("text_dropout fusion_dropout fusion_droppath attention_backend compute_precision".split()),
    "action": {"dropout"},
}
PLACES = {"view": "views", "learned_patch": "patches"}
RESIDUALS = {"normalized": "normed", "pre_norm": "plain"}
VISION_TOKENS = ("normed", "last_block")


def _file(folder: str, pattern: str, what: str, hint: str) -> str:
    found = sorted(glob.glob(os.path.join(glob.escape(folder), pattern)))
    if len(found) != 1:
        names = ", ".join(os.path.basename(name) for name in found)
        raise refuse(folder, "one file {}, {}".format(pattern, what), names or "none", hint, Code.BAD_BUNDLE if found else Code.IO)
    return found[0]


def _weights(folder: str) -> str:
    return _file(folder, "*.pth", "the weights", "put the file of one checkpoint and its statistics into a folder of their own")


def _read_tensors(folder: str, _problems: Problems) -> Tensors:
    file = _weights(folder)
    member = next((name for name in WEIGHTS if isinstance(read_torch_value(file, name), dict)), "")
    return read_torch(file, member), {}


LAYOUT = Layout(
    "TurboVLA's authors",
    (
        stats("the entry of the file of statistics to normalize with, where there are several"),
        views("names of the cameras, in the order of the policy's views; by default those of LIBERO"),
        Option(
            "--vision-tokens",
            "which tokens of DINOv3 the policy was trained on: normed, by its last norm, with transformers up to 4.57.1 (the released"
            " checkpoints); last_block with 4.57.2 and later",
            choices=VISION_TOKENS,
        ),
    ),
    files=("*.pth",),
    read=_read_tensors,
    has_config=False,
    about="""\
A checkpoint of TurboVLA's authors is a folder with one NAME.pth, their file of statistics (libero_all4_stats.json) and language_encoder/, or
--backbone, with config and tokenizer of BERT. It needs --vision-tokens: the same code of theirs reads other numbers from DINOv3 with
other releases of transformers, and the file does not say which.""",
)


@dataclass
class Sizes:
    views: Sequence[str]
    aliases: Sequence[str]
    vision_tokens: str
    max_tokens: int
    n_row: int  # rows to which a text is padded; 0: no padding
    limits: Dict[str, int]  # number of tokens by instruction, for instructions with their own number
    sentences: str
    padding: str
    places: str
    d_model: int
    n_head: int
    d_ff: int
    n_fusion: int
    n_fusion_head: int
    d_inner: int
    residual: str
    d_state: int
    d_action: int
    horizon: int
    n_state_token: int
    d_state_hidden: int
    d_hidden: int
    n_decoder: int
    vision: Vision
    rope_base: float
    n_register: int
    layers: str  # transformers' name of the list of the tower's layers
    lm: TextEncoder
    n_sentence: int
    lm_folder: str

    @property
    def d_projector(self) -> int:
        """Width of the projector (turbovla.py TurboVLA.__init__)."""
        return max(4 * self.d_model, self.vision.d_model // 2)


def read_sizes(checkpoint: Checkpoint, options: Options, problems: Problems) -> Sizes:
    file = _weights(checkpoint.folder)
    config = read_torch_value(file, CONFIG)
    if not isinstance(config, dict):
        hint = "without it the authors' evaluation takes every size from its command line; save the checkpoint with their trainer"
        raise refuse(file, CONFIG + ", a dictionary", "none" if config is None else type(config).__name__, hint)
    part = _read_parts(config, problems)
    text, vision, fusion, action = part["text"], part["vision"], part["interaction"], part["action"]
    if options.vision_tokens not in VISION_TOKENS:
        hint = "normed for the released checkpoints, and where transformers was 4.57.1 or earlier; last_block from 4.57.2 on"
        problems.add("--vision-tokens", " or ".join(VISION_TOKENS), options.vision_tokens or "none", hint, Code.USAGE)
    folder = find_backbone(checkpoint, options.backbone, text.get("model_name_or_path"), CONFIG + ".text.model_name_or_path", "language_encoder")
    bert = Section("backbone config.json", read_json(os.path.join(folder, "config.json")), TEXT, problems)
    bert.check_fixed(TEXT_FIXED, "the runtime's language model of this policy is BERT")
    dino = Section("config of the vision backbone", _vision_config(checkpoint, problems), VISION, problems)
    dino.check_fixed(VISION_FIXED, "the runtime implements DINOv3's vision transformers with plain MLPs")
    n_view, n_head = vision.count("num_views", maximum=32), fusion.count("nheads")
    names, aliases = _views(options.views, n_view, problems)
    n_row, limits = _read_padding(text)
    s = Sizes(
        views=names,
        aliases=aliases,
        vision_tokens=options.vision_tokens,
        max_tokens=n_row or text.count("max_length", MIN_TOKENS),
        n_row=n_row,
        limits=limits,
        sentences="apart" if _flag(text, "sub_sentence_present") else "together",
        padding=_padding(text, fusion),
        places=_choice(vision, "position_embedding", PLACES),
        d_model=fusion.count("hidden_dim"),
        n_head=n_head,
        d_ff=fusion.count("dim_feedforward"),
        n_fusion=fusion.count("num_layers", maximum=MAX_LAYERS),
        n_fusion_head=max(1, n_head // 2),
        d_inner=fusion.count("enhancer_inner_dim"),
        residual=_choice(fusion, "residual_style", RESIDUALS),
        d_state=action.count("state_dim"),
        d_action=action.count("action_dim"),
        horizon=action.count("horizon", maximum=4096),
        n_state_token=action.count("num_state_tokens", maximum=1024),
        d_state_hidden=action.count("state_hidden_dim"),
        d_hidden=action.count("mlp_hidden_dim"),
        n_decoder=action.count("num_layers", maximum=MAX_LAYERS),
        vision=read_vision(dino, vision.count("image_size"), dino.count("patch_size")),
        rope_base=dino.number("rope_theta"),
        n_register=dino.count("num_register_tokens", 0, 1023),
        layers="model.layer" if any(name.startswith(BACKBONE + "model.layer.") for name in checkpoint.tensors) else "layer",
        lm=read_bert(bert),
        n_sentence=bert.count("type_vocab_size"),
        lm_folder=folder,
    )
    _check_sizes(s, fusion, vision, dino, text)
    return s


def _read_parts(config: dict, problems: Problems) -> Dict[str, Section]:
    for key in sorted(set(config) - set(PARTS) - {"name", "embedding_dump"}):  # embedding_dump only writes intermediate results to files
        problems.unsupported("{}: {}".format(CONFIG, key), "a part of TurboVLAConfig", "one that this converter does not know")
    if config.get("name", "TurboVLA") != "TurboVLA":
        problems.unsupported(CONFIG + ": name", "'TurboVLA'", repr(config["name"])[:80])
    found = {}
    for name, keys in PARTS.items():
        found[name] = Section("{}.{}".format(CONFIG, name), member(config, name, dict, CONFIG), keys, problems)
        found[name].refuse_unknown(set(keys) | IGNORED[name])
    return found


def _choice(section: Section, key: str, words: Dict[str, str]) -> str:
    value = section.get(key)
    if isinstance(value, str) and value in words:
        return words[value]
    section.bad(key, " or ".join(words), hint="the reference refuses it too")
    return next(iter(words.values()))


def _flag(section: Section, key: str) -> bool:
    value = section.get(key)
    if not isinstance(value, bool):
        section.bad(key, "True or False")
    return bool(value)


def _padding(text: Section, fusion: Section) -> str:
    """The treatment of padding rows after a text: "zeroed", "zeroed_first" or "kept"."""
    zeroed = _choice(fusion, "padding_strategy", {"key_padding_mask": "", "zero_fill": "zeroed"})
    return zeroed or ("zeroed_first" if _flag(text, "zero_padded_tokens") else "kept")


def _read_padding(text: Section) -> Tuple[int, Dict[str, int]]:
    """Rows to which a text is padded, 0 without padding; and the number of tokens of instructions with their own number."""
    n_row = text.count("padding_length", MIN_TOKENS) if text.get("padding_length") is not None else 0
    limits = text.get("padding_length_by_instruction")
    if not isinstance(limits, dict):
        text.bad("padding_length_by_instruction", "instructions with numbers of tokens", type(limits).__name__)
        return n_row, {}
    if n_row > text.count("max_length", MIN_TOKENS):
        text.bad("padding_length", "at most max_length {}".format(text.get("max_length")), hint="the reference refuses it too")
    if limits and not n_row:
        text.bad("padding_length", "a number of rows, for padding_length_by_instruction", hint="the reference refuses it too")
    for instruction, n in limits.items():
        sound = isinstance(n, int) and not isinstance(n, bool) and MIN_TOKENS <= n <= n_row
        if n_row and not (isinstance(instruction, str) and instruction and sound):
            expected = "instructions with {} to padding_length {} tokens".format(MIN_TOKENS, n_row)
            text.bad("padding_length_by_instruction", expected, "{!r}: {!r}".format(instruction, n)[:120])
    return n_row, limits


def _views(given: Sequence[str], n_view: int, problems: Problems) -> Tuple[List[str], List[str]]:
    names = list(given) or (list(VIEWS) if n_view == len(VIEWS) else [])
    if len(names) != n_view or len(set(names)) != n_view or "" in names:
        problems.add("--views", "{} different names, one for each view".format(n_view), ", ".join(names) or "none", code=Code.USAGE)
    return [view_name(name) for name in names], list(ALIASES) if not given and names else [""] * len(names)


def _vision_config(checkpoint: Checkpoint, problems: Problems) -> dict:
    """The vision backbone's config: that in vision_encoder/ inside the checkpoint, else that of the only release with this width and number of
    layers."""
    path = checkpoint.path(os.path.join("vision_encoder", "config.json"))
    if os.path.exists(path):
        checkpoint.notes.append("config of the vision backbone: from vision_encoder/ inside the checkpoint")
        return read_json(path)
    token = checkpoint.tensors.get(BACKBONE + "embeddings.cls_token")
    width = token.shape[-1] if token is not None and token.shape else 0
    n_layer = len([name for name in checkpoint.tensors if name.startswith(BACKBONE) and name.endswith(".norm1.weight")])
    for name, config in DINOV3.items():
        if (config["hidden_size"], config["num_hidden_layers"]) == (width, n_layer):
            checkpoint.notes.append("config of the vision backbone: {}, which has this width and number of layers".format(name))
            return config
    hint = "put the config.json of the DINOv3 that the policy was trained with into vision_encoder/ of the checkpoint"
    problems.unsupported("vision backbone", "a DINOv3 of " + ", ".join(DINOV3), "{} wide, {} layers".format(width, n_layer), hint)
    return dict(next(iter(DINOV3.values())))


def _check_sizes(s: Sizes, fusion: Section, vision: Section, dino: Section, text: Section) -> None:
    for heads, key, width in ((s.n_head, "hidden_dim", s.d_model), (s.n_fusion_head, "enhancer_inner_dim", s.d_inner)):
        if width % heads:
            fusion.bad(key, "a multiple of {} heads".format(heads), hint="the reference refuses it too")
    if s.d_model % s.n_fusion_head:
        fusion.bad("hidden_dim", "a multiple of {} heads".format(s.n_fusion_head), hint="the reference refuses it too")
    if s.vision.image_size % s.vision.patch_size:
        vision.bad("image_size", "a multiple of patch_size {}".format(s.vision.patch_size), hint="the reference refuses it too")
    if s.vision.d_model % (4 * s.vision.n_head):
        dino.bad("num_attention_heads", "heads of a multiple of 4, for the rotary embedding")
    if s.max_tokens > s.lm.n_position:
        key = "padding_length" if s.n_row else "max_length"
        text.bad(key, "at most the {} positions of BERT".format(s.lm.n_position), hint="the runtime has one for each row")


def read_pixels(checkpoint: Checkpoint, problems: Problems) -> Dict[str, object]:
    """Mean and std of pixels, from vision_encoder/preprocessor_config.json; the defaults are ImageNet's (policy.py
    build_dinov3_manual_processor)."""
    path = checkpoint.path(os.path.join("vision_encoder", "preprocessor_config.json"))
    config = Section("preprocessor_config.json", read_json(path) if os.path.exists(path) else {}, {}, problems)
    scale = config.values.get("rescale_factor", 1 / 255)
    if not isinstance(scale, float) or abs(scale * 255 - 1) > 1e-6:
        config.bad("rescale_factor", "1 / 255", repr(scale)[:80], unsupported=True)
    found = {}
    for name, default in (("mean", IMAGENET["mean"]), ("std", IMAGENET["std"])):
        values = config.values.get("image_" + name, default)
        sound = isinstance(values, list) and len(values) == 3 and all(isinstance(v, float) and (v > 0 or name == "mean") for v in values)
        if not sound:
            config.bad("image_" + name, "three numbers", repr(values)[:80])
        found[name] = values if sound else default
    return found


def read_normalization(checkpoint: Checkpoint, name: str, widths: Dict[str, int], problems: Problems) -> Dict[str, np.ndarray]:
    """The statistics in one entry of the file, in float32 (suite_policy.py _select_stats, TurboVLAPolicy.__init__)."""
    path = _file(checkpoint.folder, STATISTICS, "the statistics", "put libero_all4_stats.json of the authors beside the weights")
    where, everything = os.path.basename(path), read_json(path)
    entries = [key for key in everything if key != "metadata"]
    if name not in everything and (name or len(entries) != 1):
        raise refuse(where, "one of " + ", ".join(entries), name or "several", "--stats NAME, the data that the policy was trained on", Code.USAGE)
    name = name or entries[0]
    entry, where = member(everything, name, dict, where), "{}: {}".format(where, name)
    state = "proprio" if "proprio" in entry else "state"
    tensors: Dict[str, np.ndarray] = {}
    for feature, group, width, statistics in (
        (recipe.STATE, state, widths["proprio"], ("mean", "std")),
        (recipe.ACTION, "action", widths["action"], ("min", "max")),
    ):
        stated = member(entry, group, dict, where)
        for statistic in statistics:
            numbers = _numbers(stated.get(statistic))
            if numbers.shape != (width,) or not np.isfinite(numbers).all() or (statistic == "std" and (numbers < 0).any()):
                expected = "{} finite numbers{}".format(width, " from 0 on" if statistic == "std" else "")
                problems.add("{}.{}.{}".format(where, group, statistic), expected, str(stated.get(statistic))[:80])
            tensors["stats.{}.{}".format(feature, statistic)] = numbers
    return tensors


def _numbers(values) -> np.ndarray:
    sound = isinstance(values, list) and all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in values)
    with np.errstate(over="ignore"):  # reported by the caller
        return np.asarray(values if sound else [], np.float64).astype(np.float32)

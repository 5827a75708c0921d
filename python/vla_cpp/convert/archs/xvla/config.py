# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Sizes of an X-VLA policy from its config.json, with refusals of everything that the runtime does not support.

An absent key has the default of the reference's own class, listed here with the key. The backbone's config is in
`florence_config`, in the form of transformers or of the authors' own code.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Dict, List, NamedTuple, Sequence, Tuple

from ...checkpoint import Checkpoint
from ...errors import Code, Problems
from ...files import member
from ...lerobot import EMPTY_CAMERA, action_width, check_keys, check_widths, no_position_rule, read_views, state_width
from ...networks import MAX_LAYERS, NORM_EPS, TextEncoder
from ...recipe import ACTION, STATE
from ...section import Section
from .. import Options

# XVLAConfig keys with effect on numbers, with the class's defaults.
POLICY = {
    "chunk_size": 32,
    "n_action_steps": 32,
    "dtype": "float32",
    "florence_config": {},
    "hidden_size": 1024,
    "depth": 24,
    "num_heads": 16,
    "mlp_ratio": 4.0,
    "num_domains": 30,
    "len_soft_prompts": 32,
    "dim_time": 32,
    "max_len_seq": 512,
    "use_hetero_proj": False,
    "action_mode": "ee6d",
    "num_denoising_steps": 10,
    "use_proprio": True,
    "max_state_dim": 32,
    "max_action_dim": 20,
    "resize_imgs_with_padding": None,
    "num_image_views": None,
    "empty_cameras": 0,
}
FIXED = {"domain_feature_key": (None, "the act names the domain, where the bundle has several")}
# Keys without effect on the numbers of an action chunk, beside those of every LeRobot policy. The preprocessor
# determines the treatment of text.
IGNORED = set(
    """
    tokenizer_name tokenizer_max_length tokenizer_padding_side pad_language_to freeze_vision_encoder freeze_language_encoder
    train_policy_transformer train_soft_prompts optimizer_soft_prompt_lr_scale optimizer_soft_prompt_warmup_lr_scale
    """.split()
)


class ActionSpace(NamedTuple):
    """A class of action_hub.py. columns: numbers of an action in the network; actions: numbers for the robot; 0: stated in the config."""

    columns: int
    actions: int
    grippers: Sequence[int] = ()  # columns that are logits; the network does not see these columns of actions and state
    state: int = 0  # numbers of the state that the network needs


SPACES = {
    "ee6d": ActionSpace(20, 20, (9, 19)),
    "joint": ActionSpace(14, 14, (6, 13)),
    "agibot_ee6d": ActionSpace(20, 20),
    "franka_joint7": ActionSpace(20, 7),
    "so101_bimanual": ActionSpace(20, 12, (5, 11), 20),
    "auto": ActionSpace(0, 0),
}
# Florence2VisionConfig and BartConfig, with the classes' defaults. Keys that they do not read have no effect in the reference either.
VISION: Dict[str, object] = {
    "depths": [1, 1, 9, 1],
    "patch_size": [7, 3, 3, 3],
    "patch_stride": [4, 2, 2, 2],
    "patch_padding": [3, 1, 1, 1],
    "patch_prenorm": [False, True, True, True],
    "embed_dim": [128, 256, 512, 1024],
    "num_heads": [4, 8, 16, 32],
    "num_groups": [4, 8, 16, 32],
    "window_size": 12,
    "mlp_ratio": 4.0,
    "projection_dim": 1024,
    "max_temporal_embeddings": 100,
    "max_position_embeddings": 50,
}
VISION_FIXED = {"qkv_bias": (True, True), "in_channels": (3, 3), "activation_function": ("gelu", "gelu")}
TEXT = {
    "d_model": 1024,
    "encoder_layers": 12,
    "encoder_attention_heads": 16,
    "encoder_ffn_dim": 4096,
    "vocab_size": 50265,
    "max_position_embeddings": 1024,
}
TEXT_FIXED = {"activation_function": ("gelu", "gelu"), "scale_embedding": (False, False)}
TEXT_TYPES = ("bart", "florence2_language")
MAX_STAGE, MAX_GROUP = 8, 64


class Stage(NamedTuple):
    d_model: int
    n_layer: int
    n_head: int
    n_group: int
    d_ff: int
    patch_size: int
    patch_stride: int
    pre_norm: bool


@dataclass
class Sizes:
    views: Sequence[str] = ()
    n_view: int = 0
    frame: Tuple[int, int] = (0, 0)  # width, height
    resizes: bool = False
    state_dim: int = 0  # 0: the policy reads none
    unread_dim: int = 0  # width of a state that robots send and the network does not read
    action_dim: int = 0
    d_state: int = 0
    d_action: int = 0
    grippers: List[int] = field(default_factory=list)
    horizon: int = 0
    n_step: int = 0
    n_token: int = 0  # number of tokens to which text is padded; 0: no padding
    pad_token: int = 0
    in_bf16: bool = False
    vendored: bool = False  # tensors have the names of the authors' own code
    tokens: str = ""  # name of the tensor with the token table
    stages: Sequence[Stage] = ()
    window: int = 0
    n_cell_position: int = 0
    n_moment: int = 0
    lm: TextEncoder = field(default_factory=TextEncoder)
    d_model: int = 0
    n_layer: int = 0
    n_head: int = 0
    d_ff: int = 0
    d_time: int = 0
    n_prompt: int = 0
    n_position: int = 0
    hetero: bool = False
    n_domain: int = 0
    domain: int = 0


def read_sizes(checkpoint: Checkpoint, options: Options, problems: Problems) -> Sizes:
    policy = Section("config.json", checkpoint.config, POLICY, problems)
    no_position_rule(policy, options, problems)
    check_keys(policy, "XVLAConfig", set(POLICY) | IGNORED, FIXED)
    s = Sizes()
    _read_policy(policy, s)
    _read_spaces(policy, checkpoint, options, s)
    _read_views(policy, checkpoint, s)
    _read_florence(policy, s, problems)
    _read_names(checkpoint, s)
    return s


def read_domain(options: Options, step: dict, n_domain: int, problems: Problems) -> int:
    """The domain of --embodiment, else of the preprocessor. Errors: usage."""
    if options.embodiment:
        stated, where, code = options.embodiment, "--embodiment", Code.USAGE
    else:
        stated, where, code = str(step.get("domain_id", 0)), "policy_preprocessor.json: xvla_add_domain_id: domain_id", Code.BAD_BUNDLE
    if stated.isdecimal() and str(int(stated)) == stated and int(stated) < n_domain:
        return int(stated)
    problems.add(where, "the number of a domain, below num_domains {}".format(n_domain), stated, code=code)
    return 0


def _read_policy(policy: Section, s: Sizes) -> None:
    s.horizon, s.n_step = policy.count("chunk_size", maximum=4096), policy.count("num_denoising_steps", maximum=1000)
    s.d_model, s.n_layer, s.n_head = policy.count("hidden_size"), policy.count("depth", maximum=MAX_LAYERS), policy.count("num_heads")
    s.d_ff = int(s.d_model * policy.number("mlp_ratio"))
    s.n_domain, s.n_prompt = policy.count("num_domains", maximum=1 << 16), policy.count("len_soft_prompts", 0, 4095)
    s.d_time, s.n_position = policy.count("dim_time", 2, 4096), policy.count("max_len_seq")
    for key in ("use_hetero_proj", "use_proprio"):
        if not isinstance(policy.get(key), bool):
            policy.bad(key, "true or false")
    s.hetero = policy.get("use_hetero_proj") is True
    if policy.get("dtype") not in ("float32", "bfloat16"):
        policy.bad("dtype", "float32 or bfloat16")
    s.in_bf16 = policy.get("dtype") == "bfloat16"
    if s.d_model % s.n_head:
        policy.bad("num_heads", "a divisor of hidden_size {}".format(s.d_model))


def _read_spaces(policy: Section, checkpoint: Checkpoint, options: Options, s: Sizes) -> None:
    """Reads the widths of actions and state. The reference cuts a wider state, so the feature should state the width that is read."""
    mode = policy.get("action_mode")
    if not isinstance(mode, str) or mode.lower() not in SPACES:
        policy.bad("action_mode", " or ".join(SPACES), unsupported=True)
        mode = "auto"
    space, feature = SPACES[mode.lower()], action_width(policy, checkpoint, options)
    s.d_action, s.action_dim, s.grippers = space.columns or policy.count("max_action_dim"), space.actions or feature, [*space.grippers]
    if feature != s.action_dim:
        checkpoint.notes.append("output feature {}: its width is {}, actions of {} have {}".format(ACTION, feature, mode, s.action_dim))
    if policy.get("use_proprio") is True:
        s.state_dim = state_width(policy, checkpoint, options)
        s.d_state = policy.count("max_state_dim")
    elif STATE in member(checkpoint.config, "input_features", dict, "config.json"):
        s.unread_dim = state_width(policy, checkpoint, options)
    check_widths(policy, {"max_state_dim": (s.d_state, s.state_dim), "max_action_dim": (s.d_action, s.action_dim)})
    lowest = max(s.grippers, default=-1) + 1
    if s.grippers and (s.d_state < lowest or s.d_state != (space.state or s.d_state)):
        wanted = str(space.state) if space.state else "{} or more".format(lowest)
        policy.bad("max_state_dim", "{}, with use_proprio, for action_mode {}".format(wanted, mode), hint="the reference fails too")


def _read_views(policy: Section, checkpoint: Checkpoint, s: Sizes) -> None:
    """Reads the views. The network has as many slots as validate_features of the reference counts; it counts views of empty_cameras twice if
    the file lists them too."""
    s.views, n_empty = read_views(policy, checkpoint)
    features = member(checkpoint.config, "input_features", dict, "config.json")
    listed = [view for view in s.views if view in features]
    stated = 0 if policy.get("num_image_views") is None else policy.count("num_image_views", maximum=32)
    s.n_view = max(stated, len(listed) + n_empty)
    if s.n_view > 32:
        policy.bad("num_image_views", "at most 32 views", str(s.n_view), unsupported=True)
    size = policy.get("resize_imgs_with_padding")
    s.resizes = size is not None
    shapes = (
        {tuple(features[view]["shape"][1:]) for view in listed if not view.startswith(EMPTY_CAMERA)}
        if not s.resizes
        else {tuple(size or ())}
    )
    height, width = next(iter(shapes)) if len(shapes) == 1 and len(next(iter(shapes))) == 2 else (None, None)
    if not all(type(side) is int and 0 < side <= 4096 for side in (height, width)):
        wanted = "(height, width)" if s.resizes else "a size, or views of one size"
        policy.bad("resize_imgs_with_padding", wanted, str(sorted(shapes)))
        return
    s.frame = width, height


def _read_florence(policy: Section, s: Sizes, problems: Problems) -> None:
    where = "config.json: florence_config"
    florence = member(policy.values, "florence_config", dict, "config.json")
    _read_vision(
        Section(where + ".vision_config", _translated(member(florence, "vision_config", dict, where), problems), VISION, problems), s
    )
    text = Section(where + ".text_config", member(florence, "text_config", dict, where), TEXT, problems)
    if text.values.get("model_type", TEXT_TYPES[1]) not in TEXT_TYPES:
        text.bad("model_type", " or ".join(TEXT_TYPES), unsupported=True)
    text.check_fixed(TEXT_FIXED, "the runtime's language model of this policy is BART's encoder")
    d_projected = s.lm.d_model
    s.lm = TextEncoder(
        d_model=text.count("d_model"),
        n_vocab=text.count("vocab_size"),
        n_position=text.count("max_position_embeddings"),
        n_layer=text.count("encoder_layers", maximum=MAX_LAYERS),
        n_head=text.count("encoder_attention_heads"),
        d_ff=text.count("encoder_ffn_dim"),
        norm_eps=NORM_EPS,
    )
    if s.lm.d_model != d_projected:
        text.bad("d_model", "projection_dim {} of the vision_config".format(d_projected))
    if s.lm.d_model % s.lm.n_head:
        text.bad("encoder_attention_heads", "a divisor of d_model {}".format(s.lm.d_model))


def _translated(vision: dict, problems: Problems) -> dict:
    """The vision config in transformers' form. Reference: configuration_xvla.py _translate_vision_config."""
    where, out = "config.json: florence_config.vision_config", dict(vision)
    kind = out.pop("model_type", None)
    if kind not in (None, "davit", "florence_vision"):
        problems.unsupported(where + ".model_type", "davit or florence_vision", repr(kind))
    for key, wanted, inside, today in (
        ("image_pos_embed", "learned_abs_2d", "max_pos_embeddings", "max_position_embeddings"),
        ("visual_temporal_embedding", "COSINE", "max_temporal_embeddings", "max_temporal_embeddings"),
    ):
        table = out.pop(key, None)
        if table is None:
            continue
        if not isinstance(table, dict) or table.get("type") != wanted:
            problems.unsupported("{}.{}".format(where, key), "type " + wanted, str(table)[:80])
        else:
            out[today] = table.get(inside)
    source = out.pop("image_feature_source", None)
    if source not in (None, ["spatial_avg_pool", "temporal_avg_pool"]):
        problems.unsupported(where + ".image_feature_source", "spatial_avg_pool and temporal_avg_pool", str(source)[:80])
    if "dim_embed" in out:
        out["embed_dim"] = out.pop("dim_embed")
    return out


def _read_vision(vision: Section, s: Sizes) -> None:
    vision.check_fixed(VISION_FIXED, "the runtime implements DaViT as Florence-2 has it")
    names = ("embed_dim", "depths", "num_heads", "num_groups", "patch_size", "patch_stride", "patch_padding", "patch_prenorm")
    columns = [_numbers(vision, name) for name in names]
    ratio = vision.number("mlp_ratio")
    s.window, s.lm.d_model = vision.count("window_size", maximum=1024), vision.count("projection_dim")
    s.n_cell_position, s.n_moment = vision.count("max_position_embeddings", maximum=4096), vision.count("max_temporal_embeddings")
    if len({len(column) for column in columns}) > 1 or not 1 <= len(columns[0]) <= MAX_STAGE:
        vision.bad(
            "embed_dim", "lists of as many numbers as stages, at most {}".format(MAX_STAGE), str([len(column) for column in columns])
        )
        return
    s.stages = [
        Stage(d, n, heads, groups, int(d * ratio), size, stride, pre) for d, n, heads, groups, size, stride, _, pre in zip(*columns)
    ]
    for stage, padding in zip(s.stages, columns[names.index("patch_padding")]):
        if stage.patch_size % 2 == 0 or padding != stage.patch_size // 2:
            vision.bad("patch_padding", "half of an odd patch_size", unsupported=True)
        if stage.d_model % stage.n_head:
            vision.bad("num_heads", "divisors of embed_dim")
        if stage.d_model % stage.n_group or stage.d_model // stage.n_group > MAX_GROUP:
            vision.bad("num_groups", "divisors of embed_dim that leave at most {} features".format(MAX_GROUP), unsupported=True)


def _numbers(vision: Section, name: str) -> list:
    """The values of a key, one per stage."""
    values, kind = vision.get(name), bool if name == "patch_prenorm" else int
    low = 0 if name == "patch_padding" else 1
    if isinstance(values, list) and all(type(value) is kind and (kind is bool or low <= value <= 1 << 16) for value in values):
        return values
    vision.bad(name, "a list of " + ("true and false" if kind is bool else "numbers above 0"))
    return []


def _read_names(checkpoint: Checkpoint, s: Sizes) -> None:
    """Finds out which tensor names the file has; the token table may have either of two names. Reference: modeling_xvla.py
    _is_vendored_florence_state_dict."""
    prefix = "model.vlm."
    s.vendored = any(
        name == prefix + "image_projection" or name.startswith(prefix + "language_model.model.") for name in checkpoint.tensors
    )
    at = prefix + ("language_model.model." if s.vendored else "language_model.")
    s.tokens = at + "shared.weight"
    if s.tokens not in checkpoint.tensors and at + "encoder.embed_tokens.weight" in checkpoint.tensors:
        s.tokens = at + "encoder.embed_tokens.weight"

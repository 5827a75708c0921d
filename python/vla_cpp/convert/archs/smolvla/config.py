# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Sizes of a SmolVLA policy from its config.json and its backbone's, with refusals of everything that the runtime does not support.

An absent key has the default of the reference's own class, listed here with the key.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from typing import List, Sequence, Tuple

from ...checkpoint import Checkpoint, find_backbone
from ...errors import Problems
from ...files import member, read_json
from ...lerobot import action_width, check_keys, check_widths, read_views, state_width
from ...networks import Language, Vision, defaults, read_language, read_vision
from ...section import ANY_INT, Section
from .. import Options

BACKBONE = "HuggingFaceTB/SmolVLM2-500M-Video-Instruct"
# SmolVLAConfig keys with effect on numbers, with the class's defaults.
POLICY = {
    "chunk_size": 50,
    "n_action_steps": 50,
    "max_state_dim": 32,
    "max_action_dim": 32,
    "resize_imgs_with_padding": [512, 512],
    "empty_cameras": 0,
    "num_steps": 10,
    "tokenizer_max_length": 48,
    "vlm_model_name": BACKBONE,
    "load_vlm_weights": False,
    "attention_mode": "cross_attn",
    "prefix_length": -1,
    "num_expert_layers": -1,
    "num_vlm_layers": 16,
    "self_attn_every_n_layers": 2,
    "expert_width_multiplier": 0.75,
    "min_period": 4e-3,
    "max_period": 4.0,
}
# Keys with the only value that the runtime supports, and the reason.
FIXED = {
    "adapt_to_pi_aloha": (False, "joint flips and gripper maps of that robot are not in the recipe"),
    "use_delta_joint_actions_aloha": (False, "the reference refuses it too"),
    "use_cache": (True, "the reference cannot take steps without its cache"),
    "add_image_special_tokens": (False, "the prefix would hold further tokens"),
}
# Keys without effect on the numbers of an action chunk, beside those of every LeRobot policy.
IGNORED = set("pad_language_to freeze_vision_encoder train_expert_only train_state_proj".split())
# SmolVLMVisionConfig and LlamaConfig, with the classes' defaults. Keys that they do not read have no effect in the reference either.
VISION = defaults(1152, 3072, 12, 16, image_size=224, patch_size=32, layer_norm_eps=1e-6)
TEXT = defaults(4096, 11008, 32, 32, vocab_size=32000, rms_norm_eps=1e-6)
VISION_FIXED = {"hidden_act": "gelu_pytorch_tanh", "num_channels": 3}
TEXT_FIXED = {"hidden_act": "silu", "attention_bias": False, "mlp_bias": False, "model_type": "llama"}
TEXT_NULLABLE = ("num_key_value_heads", "head_dim")
ROPE_BASE = 10000.0  # not from the backbone's config: the reference has its own function (apply_rope)


@dataclass
class Sizes:
    backbone: str = ""
    views: Sequence[str] = ()
    empty_cameras: int = 0
    frame: Tuple[int, int] = (0, 0)  # width, height
    state_dim: int = 0
    action_dim: int = 0
    d_state: int = 0
    d_action: int = 0
    horizon: int = 0
    n_step: int = 0
    min_period: float = 0.0
    max_period: float = 0.0
    vision: Vision = field(default_factory=Vision)
    position_precision: str = ""
    factor: int = 0
    lm: Language = field(default_factory=Language)
    d_expert: int = 0
    d_expert_ff: int = 0
    n_expert_layer: int = 0
    layer_kinds: Sequence[str] = ()
    d_kv_in: Sequence[int] = ()  # per expert layer: input width of the k and v projections


def read_sizes(checkpoint: Checkpoint, options: Options, problems: Problems) -> Sizes:
    policy = Section("config.json", checkpoint.config, POLICY, problems)
    _check_policy(policy)
    sizes = Sizes(backbone=find_backbone(checkpoint, options.backbone, policy.get("vlm_model_name")))
    config = read_json(os.path.join(sizes.backbone, "config.json"))
    where = "backbone config.json"
    vision = Section(where + ": vision_config", member(config, "vision_config", dict, where), VISION, problems)
    text = Section(where + ": text_config", member(config, "text_config", dict, where), TEXT, problems, TEXT_NULLABLE)
    backbone = Section(where, config, {"scale_factor": 2}, problems)
    backbone.fixed("model_type", "smolvlm", "--backbone needs the folder of the SmolVLM backbone")
    sizes.views, sizes.empty_cameras = read_views(policy, checkpoint)
    sizes.state_dim = state_width(policy, checkpoint, options)
    sizes.action_dim = action_width(policy, checkpoint, options)
    _read_policy(policy, sizes)
    _read_text(policy, text, sizes)
    _read_vision(vision, backbone, sizes)
    problems.raise_any()
    read_expert(policy, sizes)
    sizes.position_precision = _position_precision(policy, vision, options, checkpoint)
    return sizes


def _check_policy(policy: Section) -> None:
    check_keys(policy, "SmolVLAConfig", set(POLICY) | IGNORED, FIXED)
    if not isinstance(policy.get("load_vlm_weights"), bool):
        policy.bad("load_vlm_weights", "true or false")


def _read_policy(policy: Section, s: Sizes) -> None:
    s.d_state, s.d_action = policy.count("max_state_dim"), policy.count("max_action_dim")
    check_widths(policy, {"max_state_dim": (s.d_state, s.state_dim), "max_action_dim": (s.d_action, s.action_dim)})
    s.horizon, s.n_step = policy.count("chunk_size"), policy.count("num_steps")
    s.min_period, s.max_period = policy.number("min_period"), policy.number("max_period")
    policy.count("prefix_length", ANY_INT)  # pads the prefix with masked tokens, which changes no number
    frame = policy.get("resize_imgs_with_padding")
    if frame is None:
        policy.bad("resize_imgs_with_padding", "[width, height]", "null", "frames of any size would reach the tower", unsupported=True)
    elif not isinstance(frame, list) or len(frame) != 2 or not all(isinstance(n, int) and n > 0 for n in frame):
        policy.bad("resize_imgs_with_padding", "[width, height]")
    else:
        s.frame = (frame[0], frame[1])


def _read_text(policy: Section, text: Section, s: Sizes) -> None:
    for key, value in TEXT_FIXED.items():
        text.fixed(key, value)
    s.lm = read_language(text)
    s.lm.rope_base, wanted = ROPE_BASE, policy.count("num_vlm_layers", ANY_INT)
    s.lm.n_layer = min(wanted, s.lm.n_layer) if wanted > 0 else s.lm.n_layer
    if s.lm.n_head % s.lm.n_head_kv:
        text.bad("num_key_value_heads", "a divisor of num_attention_heads {}".format(s.lm.n_head))
    if s.lm.d_head % 2:
        text.bad("head_dim", "an even number, for the rotary embedding")


def _read_vision(vision: Section, backbone: Section, s: Sizes) -> None:
    for key, value in VISION_FIXED.items():
        vision.fixed(key, value)
    s.vision = read_vision(vision, vision.count("image_size"), vision.count("patch_size"))
    s.factor = backbone.count("scale_factor")
    if s.vision.image_size < s.vision.patch_size:
        vision.bad("image_size", "at least patch_size {}".format(s.vision.patch_size))
    width, height = s.frame
    key = "config.json: resize_imgs_with_padding"
    if width != height:
        backbone.problems.unsupported(
            key, "a square", "{} x {}".format(width, height), "the reference's pixel shuffle takes a square grid of patches"
        )
    elif width and width % (s.vision.patch_size * s.factor):
        backbone.problems.unsupported(
            key, "a multiple of patch_size * scale_factor = {}".format(s.vision.patch_size * s.factor), str(width)
        )


def _position_precision(policy: Section, vision: Section, options: Options, checkpoint: Checkpoint) -> str:
    """The precision of the position rows. The reference uses the precision of the pixels, which is the tower's: bfloat16 if the policy loads
    the backbone's weights (from_pretrained with torch_dtype bfloat16) or if vision_config says so (_from_config), else float32."""
    if options.position_precision:
        return options.position_precision
    stated = vision.get("dtype") or vision.get("torch_dtype")
    if stated not in (None, "float32", "bfloat16"):
        vision.bad(
            "dtype", "float32 or bfloat16", repr(stated), "choose the rule for the position table by --position-precision", unsupported=True
        )
    bfloat16 = policy.get("load_vlm_weights") is True or stated == "bfloat16"
    precision = "bfloat16" if bfloat16 else "float32"
    why = (
        "load_vlm_weights is true"
        if policy.get("load_vlm_weights") is True
        else "vision_config says so"
        if bfloat16
        else "the tower runs in float32"
    )
    checkpoint.notes.append("position rows of patches: as computed in {} ({}); --position-precision overrides".format(precision, why))
    return precision


# --- the action expert: lerobot src/lerobot/policies/smolvla/smolvlm_with_expert.py -----------------------------------------------


def expert_ff(d_model: int) -> int:
    """Width of the expert's MLP: 4 * floor(2 * d_model / 3), rounded up to a multiple of 256 (smolvlm_with_expert.py:
    get_intermediate_size)."""
    return 256 * ((4 * int(2 * d_model / 3) + 255) // 256)


def is_cross(i_layer: int, mode: str, every: int) -> bool:
    """Whether a layer has cross-attention. The reference calls this with two kinds of index, see `_check_expert_layers`."""
    return "cross" in mode and not (every > 0 and i_layer % every == 0)


def layer_kinds(n_layer: int, n_expert: int, mode: str, every: int) -> List[str]:
    """The expert's attention in each language-model layer during a solver step: "cross", "self" or "none" (get_model_layers, forward)."""
    ratio = n_layer // n_expert
    return ["none" if i % ratio else "cross" if is_cross(i, mode, every) else "self" for i in range(n_layer)]


def read_expert(policy: Section, s: Sizes) -> None:
    multiplier, mode = policy.number("expert_width_multiplier"), policy.get("attention_mode")
    every = policy.count("self_attn_every_n_layers", ANY_INT)
    wanted = policy.count("num_expert_layers", ANY_INT)
    if not isinstance(mode, str):
        policy.bad("attention_mode", "a string")
        return
    s.d_expert = int(s.lm.d_model * multiplier)
    s.d_expert_ff = expert_ff(s.d_expert)
    if s.d_expert < 2 or s.d_expert % 2:
        policy.bad(
            "expert_width_multiplier",
            "an even expert width, for the time embedding",
            "{} * {} = {}".format(s.lm.d_model, multiplier, s.d_expert),
        )
    s.n_expert_layer = wanted if wanted > 0 else s.lm.n_layer
    if s.lm.n_layer % s.n_expert_layer:
        policy.bad("num_expert_layers", "a divisor of the {} language-model layers".format(s.lm.n_layer), hint="the reference asserts it")
        return
    s.layer_kinds = layer_kinds(s.lm.n_layer, s.n_expert_layer, mode, every)
    _check_expert_layers(policy, s, mode, every)


def _check_expert_layers(policy: Section, s: Sizes, mode: str, every: int) -> None:
    """Refuses layers that the reference cannot run. It uses indices of expert layers to build k and v, but of language-model layers to run
    them, so with fewer expert layers the two can disagree. It also cannot run self-attention in a layer without an expert layer."""
    d_kv, ratio = s.lm.heads[1], s.lm.n_layer // s.n_expert_layer
    s.d_kv_in = [d_kv if is_cross(j, mode, every) else s.d_expert for j in range(s.n_expert_layer)]
    for i, kind in enumerate(s.layer_kinds):
        cross = is_cross(i, mode, every)
        if kind == "none" and not cross:
            policy.bad(
                "num_expert_layers",
                "an expert layer wherever self-attention runs",
                "none at layer {}".format(i),
                "the reference stops there: with fewer expert layers only cross-attention layers may lack one",
                unsupported=True,
            )
            return
        if kind != "none" and s.d_kv_in[i // ratio] != (d_kv if cross else s.d_expert):
            policy.bad(
                "num_expert_layers",
                "k and v of expert layer {} built for {}-attention".format(i // ratio, kind),
                "an input width of {}".format(s.d_kv_in[i // ratio]),
                "the reference cannot run this combination with self_attn_every_n_layers",
                unsupported=True,
            )
            return

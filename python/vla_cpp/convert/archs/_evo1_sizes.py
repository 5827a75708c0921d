# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Sizes of an Evo-1 policy: what both layouts share. The towers stand in the backbone's config.json, in two spellings: `internvl_chat`
(OpenGVLab/InternVL3-1B, remote code) and `internvl` (OpenGVLab/InternVL3-1B-hf, transformers).

An absent key means the default of the reference's own class, which is stated here beside the key. Keys that the class does not read
stay without effect there too.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Dict, Tuple

from ..errors import Problems
from ..files import member
from ..section import Section

WHERE = "backbone config.json"
MAX_LAYERS = 1024
N_TIME = 1000  # rows of the time table, a literal of the reference
Fixed = Dict[str, Tuple[object, object]]  # key -> the class's default, the value that the runtime implements

# InternVisionConfig and InternVLChatConfig of the InternVL repository; Qwen2Config of transformers.
CHAT_VISION = {
    "hidden_size": 3200,
    "intermediate_size": 12800,
    "num_hidden_layers": 48,
    "num_attention_heads": 25,
    "image_size": 224,
    "patch_size": 14,
    "layer_norm_eps": 1e-6,
}
CHAT_VISION_FIXED: Fixed = {
    "hidden_act": ("gelu", "gelu"),
    "norm_type": ("rms_norm", "layer_norm"),
    "qk_normalization": (True, False),
    "qkv_bias": (False, True),
}
CHAT_FIXED: Fixed = {
    "model_type": (None, "internvl_chat"),
    "select_layer": (-1, -1),
    "ps_version": ("v1", "v2"),
    "downsample_ratio": (0.5, 0.5),
    "use_backbone_lora": (0, 0),
    "use_llm_lora": (0, 0),
}
# InternVLVisionConfig and InternVLConfig of transformers.
HF_VISION = {
    "hidden_size": 1024,
    "intermediate_size": 4096,
    "num_hidden_layers": 24,
    "num_attention_heads": 16,
    "image_size": [448, 448],
    "patch_size": [14, 14],
    "layer_norm_eps": 1e-6,
}
HF_VISION_FIXED: Fixed = {
    "hidden_act": ("gelu", "gelu"),
    "norm_type": ("layer_norm", "layer_norm"),
    "use_qk_norm": (False, False),
    "attention_bias": (False, True),
    "num_channels": (3, 3),
    "use_absolute_position_embeddings": (True, True),
    "use_mask_token": (False, False),
    "use_mean_pooling": (True, True),  # otherwise the tower ends in a norm
}
HF_FIXED: Fixed = {
    "model_type": (None, "internvl"),
    "downsample_ratio": (0.5, 0.5),
    "projector_hidden_act": ("gelu", "gelu"),
    "vision_feature_layer": (-1, -1),
    "vision_feature_select_strategy": ("default", "default"),
}
TEXT = {
    "hidden_size": 4096,
    "intermediate_size": 22016,
    "num_hidden_layers": 32,
    "num_attention_heads": 32,
    "num_key_value_heads": 32,
    "vocab_size": 151936,
    "rms_norm_eps": 1e-6,
    "rope_theta": 10000.0,
    "max_position_embeddings": 32768,
}
TEXT_FIXED: Fixed = {
    "model_type": ("qwen2", "qwen2"),
    "hidden_act": ("silu", "silu"),
    "use_sliding_window": (False, False),
}


@dataclass
class Sizes:
    """Widths, counts and rules; the names are those of the bundle's keys."""

    d_vision: int = 0
    n_vision_layer: int = 0
    n_vision_head: int = 0
    d_vision_ff: int = 0
    image_size: int = 0
    patch_size: int = 0
    vision_eps: float = 0.0
    d_model: int = 0
    n_layer: int = 0
    n_backbone_layer: int = 0
    n_head: int = 0
    n_head_kv: int = 0
    d_head: int = 0
    d_ff: int = 0
    n_vocab: int = 0
    lm_eps: float = 0.0
    rope_base: float = 0.0
    n_head_layer: int = 0
    n_head_head: int = 0
    d_hidden: int = 0
    d_state_hidden: int = 0
    d_state: int = 0
    d_action: int = 0
    state_dim: int = 0
    action_dim: int = 0  # numbers of an action that the robot is sent
    d_robot: int = 0
    horizon: int = 0
    n_slot: int = 0
    n_token: int = 0
    n_step: int = 0
    time_scale: float = 0.0
    dead_rows: str = ""
    absent_views: str = ""

    @property
    def n_view_token(self) -> int:
        return (self.image_size // self.patch_size // 2) ** 2


def check_fixed(section: Section, fixed: Fixed, hint: str = "") -> None:
    for key, (default, value) in fixed.items():
        if section.values.get(key, default) != value:
            found = repr(section.values[key]) if key in section.values else "no such key, which means {!r}".format(default)
            section.bad(key, repr(value), found, hint, unsupported=True)


def read_chat_backbone(config: dict, s: Sizes, problems: Problems) -> None:
    """`internvl_chat`."""
    chat = Section(WHERE, config, {}, problems)
    check_fixed(chat, CHAT_FIXED, "--backbone needs the folder of OpenGVLab/InternVL3-1B")
    vision = Section(WHERE + ": vision_config", member(config, "vision_config", dict, WHERE), CHAT_VISION, problems)
    check_fixed(vision, CHAT_VISION_FIXED)
    text = _text_section(config, "llm_config", problems)
    if text.get("architectures") != ["Qwen2ForCausalLM"]:
        text.bad("architectures", "['Qwen2ForCausalLM']", unsupported=True)
    s.image_size, s.patch_size = vision.count("image_size"), vision.count("patch_size")
    if (config.get("force_image_size") or s.image_size) != s.image_size:
        chat.bad("force_image_size", "{} as in vision_config.image_size".format(s.image_size), unsupported=True)
    _read_vision(vision, s)
    _read_text(text, s)


def read_hf_backbone(config: dict, s: Sizes, problems: Problems) -> None:
    """`internvl`."""
    whole = Section(WHERE, config, {"image_seq_length": 256}, problems)
    check_fixed(whole, HF_FIXED, "--backbone needs the folder of OpenGVLab/InternVL3-1B-hf")
    vision = Section(WHERE + ": vision_config", member(config, "vision_config", dict, WHERE), HF_VISION, problems)
    check_fixed(vision, HF_VISION_FIXED)
    s.image_size, s.patch_size = _side(vision, "image_size"), _side(vision, "patch_size")
    _read_vision(vision, s)
    _read_text(_text_section(config, "text_config", problems), s)
    if s.patch_size and whole.count("image_seq_length") != s.n_view_token:
        whole.bad("image_seq_length", "{}, the tokens of a view".format(s.n_view_token))


def _text_section(config: dict, key: str, problems: Problems) -> Section:
    where = "{}: {}".format(WHERE, key)
    return Section(where, member(config, key, dict, WHERE), TEXT, problems, ("num_key_value_heads",))


def _side(section: Section, key: str) -> int:
    """A number, or a square's [height, width]."""
    value = section.get(key)
    if isinstance(value, list) and len(value) == 2 and value[0] == value[1]:
        value = value[0]
    return Section(section.where, {key: value}, {}, section.problems).count(key)


def _read_vision(vision: Section, s: Sizes) -> None:
    s.d_vision, s.d_vision_ff = vision.count("hidden_size"), vision.count("intermediate_size")
    s.n_vision_layer = vision.count("num_hidden_layers", most=MAX_LAYERS)
    s.n_vision_head, s.vision_eps = vision.count("num_attention_heads"), vision.number("layer_norm_eps")
    if s.d_vision % s.n_vision_head:
        vision.bad("num_attention_heads", "a divisor of hidden_size {}".format(s.d_vision))
    if s.image_size % (2 * s.patch_size):
        vision.bad("image_size", "a multiple of twice the patch size, {}".format(2 * s.patch_size), unsupported=True)


def _read_text(text: Section, s: Sizes) -> None:
    check_fixed(text, TEXT_FIXED)
    s.d_model, s.d_ff, s.n_vocab = text.count("hidden_size"), text.count("intermediate_size"), text.count("vocab_size")
    s.n_head = text.count("num_attention_heads")
    if "num_key_value_heads" in text.values:
        text.defaults["num_key_value_heads"] = s.n_head  # what null means
    s.n_head_kv, s.lm_eps = text.count("num_key_value_heads"), text.number("rms_norm_eps")
    s.n_backbone_layer, s.d_head = text.count("num_hidden_layers", most=MAX_LAYERS), s.d_model // s.n_head
    if s.d_model % s.n_head or s.n_head % s.n_head_kv or s.d_head % 2:
        text.bad("num_attention_heads", "heads of an even width that divide hidden_size {}, in whole groups".format(s.d_model))
    if text.get("head_dim") not in (None, s.d_head):
        text.bad("head_dim", "{}, hidden_size by heads".format(s.d_head), unsupported=True)
    kinds = text.get("layer_types")
    if kinds is not None and (not isinstance(kinds, list) or any(kind != "full_attention" for kind in kinds)):
        text.bad("layer_types", "full_attention only", str(kinds)[:80], unsupported=True)
    s.rope_base = _rope(text, s)


def _rope(text: Section, s: Sizes) -> float:
    """The base of the rotary embedding. Dynamic scaling changes nothing up to max_position_embeddings; other kinds do."""
    key = "rope_scaling" if text.get("rope_parameters") is None else "rope_parameters"
    rope, longest = member(text.values, key, dict, text.where), text.count("max_position_embeddings")
    kind = rope.get("rope_type", rope.get("type", "default"))
    if kind != "default" and (kind != "dynamic" or s.n_token > longest):
        expected = "none, or dynamic from {} positions on, which is beyond the prompt's {}".format(longest, s.n_token)
        text.bad(key, expected, str(rope)[:120], unsupported=True)
    if "rope_theta" in rope:
        return Section("{}: {}".format(text.where, key), rope, {}, text.problems).number("rope_theta")
    return text.number("rope_theta")


def check_head(policy: Section, s: Sizes, embed_dim: int) -> None:
    """What the head must share with the towers, and the shapes of it that the runtime does not have."""
    if embed_dim != s.d_model:
        policy.bad("embed_dim", "the language model's width {}".format(s.d_model))
    if s.d_model % s.n_head_head:
        policy.bad("num_heads", "a divisor of embed_dim {}".format(s.d_model))
    if s.horizon == 1:
        policy.bad("horizon", "at least 2", "1", "the reference has another action encoder for single actions", unsupported=True)

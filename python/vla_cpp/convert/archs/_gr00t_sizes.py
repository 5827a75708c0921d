# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Sizes of GR00T N1.7, from its config.json and from that of its backbone, a Qwen3-VL.

An absent key means the default of the authors' own class, which is stated here beside the key. LeRobot's copy of that class has other
defaults for `select_layer`, `diffusion_model_cfg` and `vl_self_attention_cfg`, those of the published checkpoint; where a checkpoint leaves
one of them out, its tensors fit the one or the other, and what does not fit is refused.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Dict, List, Tuple

from ..errors import Problems
from ..files import member
from ..section import Section

POLICY, WHERE = "config.json", "backbone config.json"
MAX_LAYERS = 1024
Fixed = Dict[str, Tuple[object, object]]  # key -> the class's default, the value that the runtime implements

# gr00t/configs/model/gr00t_n1d7.py of Isaac-GR00T.
DIT_DEFAULT = {
    "positional_embeddings": None,
    "num_layers": 16,
    "num_attention_heads": 32,
    "attention_head_dim": 48,
    "norm_type": "ada_norm",
    "output_dim": 1024,
    "interleave_self_attention": True,
}
CONFIG = {
    "select_layer": 12,
    "backbone_embedding_dim": 2048,
    "max_state_dim": 132,
    "max_action_dim": 132,
    "action_horizon": 40,
    "hidden_size": 1024,
    "input_embedding_dim": 1536,
    "max_seq_len": 1024,
    "attend_text_every_n_blocks": 2,
    "diffusion_model_cfg": DIT_DEFAULT,
    "vl_self_attention_cfg": None,
    "num_inference_timesteps": 4,
    "num_timestep_buckets": 1000,
    "max_num_embodiments": 32,
    "model_name": "nvidia/Cosmos-Reason2-2B",
}
FIXED: Fixed = {
    "model_type": (None, "Gr00tN1d7"),
    "backbone_model_type": ("qwen", "qwen"),
    "reproject_vision": (False, False),
    "state_history_length": (1, 1),
    "add_pos_embed": (True, True),
    "use_vlln": (True, True),
    "use_alternate_vl_dit": (True, True),
    "exclude_state": (False, False),
    "strict_action_padding_mask": (False, False),
    "use_tactile": (False, False),
}
# Keys of training, of precision and of transformers, and those of pictures, text and statistics, which processor_config.json states for
# the processor: that is where the reference reads them.
IGNORED = set(
    """
    architectures model_dtype dtype torch_dtype transformers_version _name_or_path model_revision tune_top_llm_layers tune_llm
    tune_visual tune_projector tune_diffusion_model tune_vlln use_flash_attention load_bf16 backbone_trainable_params_fp32
    attn_dropout noise_beta_alpha noise_beta_beta noise_s state_dropout_prob rtc_ramp_rate image_crop_size image_target_size
    shortest_image_edge crop_fraction random_rotation_angle color_jitter_params use_albumentations_transforms letter_box_transform
    extra_augmentation_config formalize_language apply_sincos_state_encoding use_percentiles use_relative_action use_mean_std
    tactile_state_keys tactile_input_shape tactile_embed_dim return_dict output_hidden_states id2label label2id problem_type
    chunk_size_feed_forward is_encoder_decoder output_attentions
    """.split()
)
# DiT and SelfAttentionTransformer of gr00t/model/modules/dit.py.
TRANSFORMER = {"num_attention_heads": 8, "attention_head_dim": 64, "num_layers": 12, "output_dim": 26}
TRANSFORMER_FIXED: Fixed = {
    "attention_bias": (True, True),
    "activation_fn": ("gelu-approximate", "gelu-approximate"),
    "upcast_attention": (False, False),
    "positional_embeddings": ("sinusoidal", None),
}
DIT_FIXED: Fixed = {
    **TRANSFORMER_FIXED,
    "norm_type": ("ada_norm", "ada_norm"),
    "norm_elementwise_affine": (False, False),
    "norm_eps": (1e-5, 1e-5),
    "interleave_self_attention": (False, True),
}
TRANSFORMER_IGNORED = {"dropout", "final_dropout", "num_embeds_ada_norm", "max_num_positional_embeddings", "compute_dtype"}
# Qwen3VLVisionConfig, Qwen3VLTextConfig and Qwen3VLConfig of transformers.
VISION = {
    "depth": 27,
    "hidden_size": 1152,
    "intermediate_size": 4304,
    "num_heads": 16,
    "patch_size": 16,
    "out_hidden_size": 3584,
    "num_position_embeddings": 2304,
    "deepstack_visual_indexes": [8, 16, 24],
}
VISION_FIXED: Fixed = {
    "hidden_act": ("gelu_pytorch_tanh", "gelu_pytorch_tanh"),
    "in_channels": (3, 3),
    "spatial_merge_size": (2, 2),
    "temporal_patch_size": (2, 2),
}
TEXT = {
    "vocab_size": 151936,
    "hidden_size": 4096,
    "intermediate_size": 22016,
    "num_hidden_layers": 32,
    "num_attention_heads": 32,
    "num_key_value_heads": 32,
    "head_dim": 128,
    "max_position_embeddings": 128000,
    "rms_norm_eps": 1e-6,
    "rope_theta": 500000.0,
}
TEXT_FIXED: Fixed = {"hidden_act": ("silu", "silu"), "attention_bias": (False, False)}


@dataclass
class Sizes:
    """Widths and counts; the names are those of the bundle's keys."""

    d_vision: int = 0
    n_vision_layer: int = 0
    n_vision_head: int = 0
    d_vision_ff: int = 0
    patch_size: int = 0
    image_width: int = 0
    image_height: int = 0
    n_position_side: int = 0
    deepstack_layers: List[int] = field(default_factory=list)
    d_model: int = 0
    n_layer: int = 0
    n_head: int = 0
    n_head_kv: int = 0
    d_head: int = 0
    d_ff: int = 0
    n_vocab: int = 0
    n_context: int = 0
    lm_eps: float = 0.0
    rope_base: float = 0.0
    rope_sections: List[int] = field(default_factory=list)
    n_vl_layer: int = 0
    n_vl_head: int = 1
    d_dit: int = 0
    n_dit_layer: int = 0
    n_dit_head: int = 0
    d_out: int = 0
    text_every: int = 0
    n_bucket: int = 0
    d_hidden: int = 0
    d_state: int = 0
    d_action: int = 0
    horizon: int = 0
    n_position: int = 0
    n_step: int = 0
    n_embodiment: int = 0
    embodiment: int = 0  # index among them
    n_slot: int = 0
    d_time: int = 256  # a literal of the reference, as is the factor 4 of the feed-forward parts

    @property
    def d_vl_ff(self) -> int:
        return 4 * self.d_model

    @property
    def d_dit_ff(self) -> int:
        return 4 * self.d_dit

    @property
    def n_view_token(self) -> int:
        return self.image_width // (2 * self.patch_size) * (self.image_height // (2 * self.patch_size))


def check_fixed(section: Section, fixed: Fixed, hint: str = "") -> None:
    for key, (default, value) in fixed.items():
        section.defaults[key] = default
        if section.get(key) != value:
            section.bad(key, repr(value), hint=hint, unsupported=True)


def refuse_unknown(section: Section, known: set) -> None:
    for key in sorted(set(section.values) - known):
        hint = "it may change numbers; a newer vla-convert may know it"
        section.bad(key, "a key that this converter knows", hint=hint, unsupported=True)


def read_sizes(config: dict, backbone: dict, problems: Problems) -> Sizes:
    s, policy = Sizes(), Section(POLICY, config, CONFIG, problems, nullable=("diffusion_model_cfg",))
    refuse_unknown(policy, {*CONFIG, *FIXED, *IGNORED})
    check_fixed(policy, FIXED)
    _read_backbone(backbone, policy.count("select_layer", most=MAX_LAYERS), s, problems)
    s.d_state, s.d_action, s.horizon = (policy.count(key) for key in ("max_state_dim", "max_action_dim", "action_horizon"))
    s.d_hidden, s.n_position, s.n_embodiment = (policy.count(key) for key in ("hidden_size", "max_seq_len", "max_num_embodiments"))
    s.n_step, s.n_bucket = policy.count("num_inference_timesteps"), policy.count("num_timestep_buckets")
    s.text_every = policy.count("attend_text_every_n_blocks")
    if policy.count("backbone_embedding_dim") != s.d_model:
        policy.bad("backbone_embedding_dim", "the language model's width {}".format(s.d_model))
    if s.n_position < s.horizon:
        policy.bad("max_seq_len", "a row for each of the {} actions".format(s.horizon))
    _read_transformer(policy, s)
    _read_attention(policy, s)
    return s


def _transformer(policy: Section, key: str, fixed: Fixed) -> Section:
    values = member({key: policy.get(key)}, key, dict, POLICY)
    section = Section("{}: {}".format(POLICY, key), values, TRANSFORMER, policy.problems)
    refuse_unknown(section, {*TRANSFORMER, *fixed, *TRANSFORMER_IGNORED})
    check_fixed(section, fixed)
    return section


def _read_transformer(policy: Section, s: Sizes) -> None:
    dit = _transformer(policy, "diffusion_model_cfg", DIT_FIXED)
    s.n_dit_layer, s.n_dit_head = dit.count("num_layers", most=MAX_LAYERS), dit.count("num_attention_heads")
    s.d_dit, s.d_out = s.n_dit_head * dit.count("attention_head_dim"), dit.count("output_dim")
    if policy.count("input_embedding_dim") != s.d_dit:
        policy.bad("input_embedding_dim", "{}, the heads of diffusion_model_cfg side by side".format(s.d_dit))
    if s.d_dit % 2:
        policy.bad("input_embedding_dim", "an even number")
    if s.d_out != s.d_hidden:
        dit.bad("output_dim", "hidden_size {}, which the decoder reads".format(s.d_hidden))


def _read_attention(policy: Section, s: Sizes) -> None:
    """Absent, or without layers, the features pass as they are."""
    if not policy.get("vl_self_attention_cfg"):
        return
    attention = _transformer(policy, "vl_self_attention_cfg", TRANSFORMER_FIXED)
    s.n_vl_layer = attention.count("num_layers", least=0, most=MAX_LAYERS)
    if not s.n_vl_layer:
        return
    s.n_vl_head = attention.count("num_attention_heads")
    if s.n_vl_head * attention.count("attention_head_dim") != s.d_model:
        attention.bad("num_attention_heads", "heads that make the language model's width {}".format(s.d_model))


def _read_backbone(config: dict, kept: int, s: Sizes, problems: Problems) -> None:
    whole = Section(WHERE, config, {}, problems)
    check_fixed(whole, {"model_type": (None, "qwen3_vl")}, "--backbone needs the folder of nvidia/Cosmos-Reason2-2B")
    text = Section(WHERE + ": text_config", member(config, "text_config", dict, WHERE), TEXT, problems)
    _read_text(text, kept, s)
    _read_vision(Section(WHERE + ": vision_config", member(config, "vision_config", dict, WHERE), VISION, problems), s)


def _read_vision(vision: Section, s: Sizes) -> None:
    check_fixed(vision, VISION_FIXED)
    side = vision.get("patch_size")
    if isinstance(side, list) and len(side) == 2 and side[0] == side[1]:
        vision.values = {**vision.values, "patch_size": side[0]}
    s.patch_size, s.n_vision_layer = vision.count("patch_size"), vision.count("depth", most=MAX_LAYERS)
    s.d_vision, s.d_vision_ff = vision.count("hidden_size"), vision.count("intermediate_size")
    s.n_vision_head = vision.count("num_heads")
    s.n_position_side = math.isqrt(vision.count("num_position_embeddings"))
    if s.d_vision % s.n_vision_head or s.d_vision // s.n_vision_head % 4:
        vision.bad("num_heads", "heads of a multiple of 4, which divide hidden_size {}".format(s.d_vision))
    if s.n_position_side**2 != vision.get("num_position_embeddings"):
        vision.bad("num_position_embeddings", "a square")
    if vision.count("out_hidden_size") != s.d_model:
        vision.bad("out_hidden_size", "the language model's width {}".format(s.d_model))
    layers = vision.get("deepstack_visual_indexes")
    if (
        not isinstance(layers, list)
        or any(type(i) is not int or not 0 <= i < s.n_vision_layer for i in layers)
        or sorted(set(layers)) != layers
        or not 1 <= len(layers) <= s.n_layer
    ):
        expected = "rising numbers of layers below {}, no more than the {} language layers".format(s.n_vision_layer, s.n_layer)
        vision.bad("deepstack_visual_indexes", expected)
        layers = []
    s.deepstack_layers = layers


def _read_text(text: Section, kept: int, s: Sizes) -> None:
    check_fixed(text, TEXT_FIXED)
    s.d_model, s.d_ff, s.n_vocab = text.count("hidden_size"), text.count("intermediate_size"), text.count("vocab_size")
    s.n_layer, s.n_head = min(kept, text.count("num_hidden_layers", most=MAX_LAYERS)), text.count("num_attention_heads")
    text.nullable = ("num_key_value_heads",)
    if text.values.get("num_key_value_heads", 0) is None:
        text.defaults["num_key_value_heads"] = s.n_head
    s.n_head_kv, s.d_head = text.count("num_key_value_heads"), text.count("head_dim")
    s.lm_eps, s.n_context = text.number("rms_norm_eps"), text.count("max_position_embeddings")
    if s.n_head % s.n_head_kv or s.d_head % 2:
        text.bad("num_attention_heads", "heads of an even width in whole groups of {}".format(s.n_head_kv))
    _read_rope(text, s)


def _read_rope(text: Section, s: Sizes) -> None:
    """Either spelling of transformers: rope_parameters, or rope_scaling beside rope_theta."""
    key = "rope_scaling" if text.get("rope_parameters") is None else "rope_parameters"
    values = member(text.values, key, dict, text.where)
    rope = Section("{}: {}".format(text.where, key), values, {"mrope_section": [24, 20, 20]}, text.problems)
    refuse_unknown(rope, {"mrope_section", "mrope_interleaved", "rope_type", "type", "rope_theta"})
    if rope.get("rope_type") not in (None, "default") or rope.get("type") not in (None, "default", "mrope"):
        rope.bad("rope_type", "'default'", unsupported=True)
    check_fixed(rope, {"mrope_interleaved": (True, True)})
    s.rope_base = (rope if "rope_theta" in values else text).number("rope_theta")
    sections = rope.get("mrope_section")
    counts = isinstance(sections, list) and len(sections) == 3 and all(type(n) is int and n > 0 for n in sections)
    if not counts or sum(sections) != s.d_head // 2 or 3 * max(sections[1:]) > s.d_head // 2:
        expected = "three counts for time, height and width that make {}, half a head's width".format(s.d_head // 2)
        rope.bad("mrope_section", expected)
        sections = [1, 1, 1]
    s.rope_sections = sections

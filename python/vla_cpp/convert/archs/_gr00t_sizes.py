# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Sizes of GR00T N1.7, from its config.json and from that of its backbone, a Qwen3-VL.

An absent key means the default of the authors' own class, which is stated here beside the key. LeRobot's copy of that class has other
defaults for `select_layer`, `diffusion_model_cfg` and `vl_self_attention_cfg`, those of the published checkpoint; where a checkpoint leaves
one of them out, its tensors fit the one or the other, and what does not fit is refused.
"""

from __future__ import annotations

from ..errors import Problems
from ..files import member
from ..section import Section
from ._gr00t_backbone import MAX_LAYERS, Fixed, Sizes, check_fixed, read_backbone, refuse_unknown

POLICY = "config.json"

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
TRANSFORMER_IGNORED = {
    "dropout",
    "final_dropout",
    "num_embeds_ada_norm",
    "max_num_positional_embeddings",
    "compute_dtype",
}


def read_sizes(config: dict, backbone: dict, problems: Problems) -> Sizes:
    s, policy = Sizes(), Section(POLICY, config, CONFIG, problems, nullable=("diffusion_model_cfg",))
    refuse_unknown(policy, {*CONFIG, *FIXED, *IGNORED})
    check_fixed(policy, FIXED)
    read_backbone(backbone, policy.count("select_layer", most=MAX_LAYERS), s, problems)
    s.d_state, s.d_action, s.horizon = (
        policy.count(key) for key in ("max_state_dim", "max_action_dim", "action_horizon")
    )
    s.d_hidden, s.n_position, s.n_embodiment = (
        policy.count(key) for key in ("hidden_size", "max_seq_len", "max_num_embodiments")
    )
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

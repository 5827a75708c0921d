# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The common part of Evo-1's two layouts: sizes, keys and tensors of a bundle. The backbone's config.json describes the towers, in one of two
forms: `internvl_chat` (OpenGVLab/InternVL3-1B, remote code) and `internvl` (OpenGVLab/InternVL3-1B-hf, transformers).

An absent key has the default of the reference's own class, listed here with the key. Keys that the class does not read
have no effect in the reference either.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import List, NamedTuple

from ...bundle import Key
from ...errors import Problems
from ...files import member
from ...layers import QWEN2, Names, Rows, blocks, linear, norm, patch_embed, table, vector
from ...networks import NORM_EPS, Language, Vision, check_heads, decoder, defaults, keys_of, pick, read_language, read_vision
from ...section import Fixed, Section

WHERE = "backbone config.json"
N_TIME = 1000  # rows of the table of times, a literal of the reference

# Defaults of InternVisionConfig and InternVLChatConfig (InternVL repository) and of Qwen2Config (transformers).
CHAT_VISION = defaults(3200, 12800, 48, 25, image_size=224, patch_size=14, layer_norm_eps=1e-6)
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
# Defaults of transformers' InternVLVisionConfig and InternVLConfig.
HF_VISION = defaults(1024, 4096, 24, 16, image_size=[448, 448], patch_size=[14, 14], layer_norm_eps=1e-6)
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
TEXT = defaults(
    4096, 22016, 32, 32, num_key_value_heads=32, vocab_size=151936, rms_norm_eps=1e-6, rope_theta=10000.0, max_position_embeddings=32768
)
TEXT_FIXED: Fixed = {"model_type": ("qwen2", "qwen2"), "hidden_act": ("silu", "silu"), "use_sliding_window": (False, False)}


@dataclass
class Sizes:
    vision: Vision = field(default_factory=Vision)
    lm: Language = field(default_factory=Language)
    n_layer: int = 0  # layers of the backbone that the policy keeps
    n_head_layer: int = 0
    n_head_head: int = 0
    d_hidden: int = 0
    d_state_hidden: int = 0
    d_state: int = 0
    d_action: int = 0
    state_dim: int = 0
    action_dim: int = 0  # numbers of an action that the robot gets
    d_robot: int = 0
    horizon: int = 0
    max_views: int = 0
    n_token: int = 0
    n_step: int = 0
    time_scale: float = 0.0
    masked_rows: str = ""
    absent_views: str = ""

    @property
    def n_view_token(self) -> int:
        return (self.vision.image_size // self.vision.patch_size // 2) ** 2


def read_chat_backbone(config: dict, s: Sizes, problems: Problems) -> None:
    """Reads a config of the form `internvl_chat`."""
    chat = Section(WHERE, config, {}, problems)
    chat.check_fixed(CHAT_FIXED, "--backbone needs the folder of OpenGVLab/InternVL3-1B")
    vision = Section(WHERE + ": vision_config", member(config, "vision_config", dict, WHERE), CHAT_VISION, problems)
    vision.check_fixed(CHAT_VISION_FIXED)
    text = _text_section(config, "llm_config", problems)
    if text.get("architectures") != ["Qwen2ForCausalLM"]:
        text.bad("architectures", "['Qwen2ForCausalLM']", unsupported=True)
    side = vision.count("image_size")
    if (config.get("force_image_size") or side) != side:
        chat.bad("force_image_size", "{} as in vision_config.image_size".format(side), unsupported=True)
    _read_vision(vision, side, vision.count("patch_size"), s)
    _read_text(text, s)


def read_hf_backbone(config: dict, s: Sizes, problems: Problems) -> None:
    """Reads a config of the form `internvl`."""
    whole = Section(WHERE, config, {"image_seq_length": 256}, problems)
    whole.check_fixed(HF_FIXED, "--backbone needs the folder of OpenGVLab/InternVL3-1B-hf")
    vision = Section(WHERE + ": vision_config", member(config, "vision_config", dict, WHERE), HF_VISION, problems)
    vision.check_fixed(HF_VISION_FIXED)
    _read_vision(vision, _side(vision, "image_size"), _side(vision, "patch_size"), s)
    _read_text(_text_section(config, "text_config", problems), s)
    if whole.count("image_seq_length") != s.n_view_token:
        whole.bad("image_seq_length", "{}, the tokens of a view".format(s.n_view_token))


def _text_section(config: dict, key: str, problems: Problems) -> Section:
    where = "{}: {}".format(WHERE, key)
    return Section(where, member(config, key, dict, WHERE), TEXT, problems, ("num_key_value_heads", "head_dim"))


def _side(section: Section, key: str) -> int:
    """A side, stated as a number or as [height, width] of a square."""
    value = section.get(key)
    if isinstance(value, list) and len(value) == 2 and value[0] == value[1]:
        value = value[0]
    return Section(section.where, {key: value}, {}, section.problems).count(key)


def _read_vision(vision: Section, image_size: int, patch_size: int, s: Sizes) -> None:
    s.vision = read_vision(vision, image_size, patch_size)
    if image_size % (2 * patch_size):
        vision.bad("image_size", "a multiple of twice the patch size, {}".format(2 * patch_size), unsupported=True)


def _read_text(text: Section, s: Sizes) -> None:
    """Reads the language model's config. `s.n_layer`: number of layers that the policy keeps."""
    text.check_fixed(TEXT_FIXED)
    s.lm = lm = read_language(text)
    lm.n_layer, d_head = min(s.n_layer, lm.n_layer), lm.d_model // lm.n_head
    check_heads(text, lm)
    if lm.d_head != d_head:
        text.bad("head_dim", "{}, hidden_size by heads".format(d_head), unsupported=True)
    kinds = text.get("layer_types")
    if kinds is not None and (not isinstance(kinds, list) or any(kind != "full_attention" for kind in kinds)):
        text.bad("layer_types", "full_attention only", str(kinds)[:80], unsupported=True)
    lm.rope_base = _rope(text, s)


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
    """Checks that the head fits the towers, and refuses shapes of the head that the runtime does not support."""
    if embed_dim != s.lm.d_model:
        policy.bad("embed_dim", "the language model's width {}".format(s.lm.d_model))
    if s.lm.d_model % s.n_head_head:
        policy.bad("num_heads", "a divisor of embed_dim {}".format(s.lm.d_model))
    if s.horizon == 1:
        policy.bad("horizon", "at least 2", "1", "the reference has another action encoder for single actions", unsupported=True)


def network_keys(s: Sizes) -> List[Key]:
    head = dict(n_layer=s.n_head_layer, n_head=s.n_head_head, d_ff=4 * s.lm.d_model, **pick(s, "d_hidden d_state_hidden"))
    return keys_of(
        {
            "policy": pick(s, "d_state d_action horizon d_robot max_views n_token time_scale masked_rows absent_views"),
            "vision": s.vision,
            "connector": dict(factor=2, norm_eps=NORM_EPS),
            "lm": s.lm,
            "head": dict(head, norm_eps=NORM_EPS),
            "solver": dict(steps=s.n_step, t_start=0.0, t_end=1.0, kind="euler", noise="uniform"),
        }
    )


# --- tensors: the authors' names and LeRobot's, which differ in the towers and not in the head ------------------------------------------


class Spelling(NamedTuple):
    """Tensor names of one layout. class_token, position and patch follow the prefix `vision`; the connector's names follow `connector`."""

    vision: str
    class_token: str
    position: str
    patch: str
    blocks: str
    block: Names
    connector: str
    lm: str
    head: str


AUTHORS = Spelling(
    vision="embedder.model.vision_model.",
    class_token="embeddings.class_embedding",
    position="embeddings.position_embedding",
    patch="embeddings.patch_embedding",
    blocks="encoder.layers.{}.",
    block=Names("attn.qkv. attn.proj", "mlp.fc1 mlp.fc2", "norm1 norm2", scales="ls1 ls2"),
    connector="embedder.model.mlp1. 0 1 3",
    lm="embedder.model.language_model.model.",
    head="action_head.",
)
LEROBOT = Spelling(
    vision="model.embedder.model.vision_tower.",
    class_token="embeddings.cls_token",
    position="embeddings.position_embeddings",
    patch="embeddings.patch_embeddings.projection",
    blocks="encoder.layer.{}.",
    block=Names(
        "attention.q_proj attention.k_proj attention.v_proj attention.projection_layer",
        "mlp.fc1 mlp.fc2",
        "layernorm_before layernorm_after",
        scales="lambda_1 lambda_2",
    ),
    connector="model.embedder.model.multi_modal_projector. layer_norm linear_1 linear_2",
    lm="model.embedder.model.language_model.",
    head="model.action_head.",
)
HEAD = Names("attn.in_proj_ attn.out_proj", "ff.0 ff.2", "norm1 norm2")


def weights(s: Sizes, names: Spelling) -> Rows:
    v, d, at, n_position = s.vision, s.lm.d_model, names.vision, s.vision.n_patch + 1
    connector, first, up, down = names.connector.split()
    return [
        *vector("vision.class_token.weight", at + names.class_token, v.d_model, (1, 1, v.d_model)),
        *patch_embed(at + names.patch, v.d_model, v.patch_size),
        *table("vision.position", at + names.position, n_position, v.d_model, (1, n_position, v.d_model)),
        *blocks("vision.", at + names.blocks, names.block, v.n_layer, v.d_model, v.d_ff),
        *norm("connector.norm", connector + first, 4 * v.d_model),
        *linear("connector.up", connector + up, d, 4 * v.d_model),
        *linear("connector.down", connector + down, d, d),
        *decoder(s.lm, names.lm, QWEN2),
        *_head(s, names.head),
    ]


def _waves(target: str, source: str, n_row: int, d: int) -> Rows:
    """A table of sines and cosines, which are not parameters: if stored in float32 it stays in float32, whatever the matrices' type."""
    return table(target, source, n_row, d, (1, n_row, d), keep_f32=True)


def _head(s: Sizes, head: str) -> Rows:
    d, encoder = s.lm.d_model, head + "action_encoder."
    return [
        *linear("state_in", head + "state_encoder.fc1.linear", s.d_state_hidden, s.d_state),
        *linear("state_out", head + "state_encoder.fc2.linear", d, s.d_state_hidden),
        *_waves("time", head + "time_pos_enc.pe", N_TIME, d),
        *linear("action_in", encoder + "W1.linear", d, s.d_action),
        *linear("action_mix", encoder + "W2.linear", d, d),
        *linear("action_token", encoder + "W3.linear", d, d),
        *_waves("action_position", encoder + "pos_encoding.pe", s.horizon, d),
        *blocks("head.", head + "transformer_blocks.{}.", HEAD, s.n_head_layer, d, 4 * d),
        *norm("head.norm", head + "norm_out", d),
        *linear("pool", head + "seq_pool_proj", d, s.horizon * d),
        *linear("velocity_in", head + "mlp_head.fc1.linear", s.d_hidden, d),
        *linear("velocity_out", head + "mlp_head.fc2.linear", s.horizon * s.d_action, s.d_hidden),
    ]

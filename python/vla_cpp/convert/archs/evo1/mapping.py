# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Sizes of an Evo-1 policy: what both layouts share, as keys and tensors of a bundle. The towers stand in the backbone's config.json, in two spellings: `internvl_chat`
(OpenGVLab/InternVL3-1B, remote code) and `internvl` (OpenGVLab/InternVL3-1B-hf, transformers).

An absent key means the default of the reference's own class, which is stated here beside the key. Keys that the class does not read
stay without effect there too.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Dict, List, NamedTuple, Sequence, Tuple

from ...bundle import Key, keys_by_type
from ...errors import Problems
from ...files import member
from ...layers import gated_block, linear, norm, vector
from ...section import Section
from .. import MATRIX, TABLE, VECTOR, Weight

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


def network_keys(s: Sizes) -> List[Key]:
    u32 = {
        "policy.d_state": s.d_state,
        "policy.d_action": s.d_action,
        "policy.horizon": s.horizon,
        "policy.d_robot": s.d_robot,
        "policy.n_slot": s.n_slot,
        "policy.n_token": s.n_token,
        "vision.d_model": s.d_vision,
        "vision.n_layer": s.n_vision_layer,
        "vision.n_head": s.n_vision_head,
        "vision.d_ff": s.d_vision_ff,
        "vision.image_size": s.image_size,
        "vision.patch_size": s.patch_size,
        "connector.factor": 2,
        "lm.d_model": s.d_model,
        "lm.n_layer": s.n_layer,
        "lm.n_head": s.n_head,
        "lm.n_head_kv": s.n_head_kv,
        "lm.d_head": s.d_head,
        "lm.d_ff": s.d_ff,
        "lm.n_vocab": s.n_vocab,
        "head.n_layer": s.n_head_layer,
        "head.n_head": s.n_head_head,
        "head.d_ff": 4 * s.d_model,
        "head.d_hidden": s.d_hidden,
        "head.d_state_hidden": s.d_state_hidden,
        "solver.steps": s.n_step,
    }
    f32 = {
        "vision.norm_eps": s.vision_eps,
        "connector.norm_eps": 1e-5,  # torch's default, which the reference leaves as it is
        "lm.norm_eps": s.lm_eps,
        "lm.rope_base": s.rope_base,
        "head.norm_eps": 1e-5,
    }
    f64 = {"policy.time_scale": s.time_scale, "solver.t_start": 0.0, "solver.t_end": 1.0}
    text = {
        "policy.dead_rows": s.dead_rows,
        "policy.absent_views": s.absent_views,
        "solver.kind": "euler",
        "solver.noise": "uniform",
    }
    return keys_by_type({"u32": u32, "f32": f32, "f64": f64, "string": text})


# --- tensors: the authors' names and LeRobot's, which differ in the towers and not in the head ------------------------------------------

class Names(NamedTuple):
    """Modules of a tower by what they are. `qkv`: one name where q, k and v are stacked, which ends before "weight" and "bias",
    else three."""

    vision: str
    class_token: str
    position: str
    patch: str
    block: str
    norms: Sequence[str]
    qkv: Sequence[str]
    out: str
    scales: Sequence[str]
    connector: Sequence[str]
    lm: str
    head: str


AUTHORS = Names(
    vision="embedder.model.vision_model.",
    class_token="embeddings.class_embedding",
    position="embeddings.position_embedding",
    patch="embeddings.patch_embedding",
    block="encoder.layers.{}.",
    norms=("norm1", "norm2"),
    qkv=("attn.qkv.",),
    out="attn.proj",
    scales=("ls1", "ls2"),
    connector=tuple("embedder.model.mlp1." + part for part in "013"),
    lm="embedder.model.language_model.model.",
    head="action_head.",
)
LEROBOT = Names(
    vision="model.embedder.model.vision_tower.",
    class_token="embeddings.cls_token",
    position="embeddings.position_embeddings",
    patch="embeddings.patch_embeddings.projection",
    block="encoder.layer.{}.",
    norms=("layernorm_before", "layernorm_after"),
    qkv=tuple("attention.{}_proj".format(part) for part in "qkv"),
    out="attention.projection_layer",
    scales=("lambda_1", "lambda_2"),
    connector=tuple("model.embedder.model.multi_modal_projector." + part for part in ("layer_norm", "linear_1", "linear_2")),
    lm="model.embedder.model.language_model.",
    head="model.action_head.",
)


def weights(s: Sizes, names: Names) -> List[Weight]:
    return [*_vision(s, names), *_connector(s, names), *_language(s, names), *_head(s, names.head)]


def _stacked(target: str, source: str, d: int) -> List[Weight]:
    """q, k and v of width d as thirds of the rows of one matrix and one bias. `source`: their name up to "weight" and "bias"."""
    rows: List[Weight] = []
    for i, part in enumerate(("attn_q", "attn_k", "attn_v")):
        rows += [
            Weight(target + part + ".weight", source + "weight", MATRIX, (3 * d, d), (d, d), first=i * d),
            Weight(target + part + ".bias", source + "bias", VECTOR, (3 * d,), (d,), first=i * d),
        ]
    return rows


def _qkv(target: str, block: str, names: Sequence[str], d: int) -> List[Weight]:
    if len(names) == 1:
        return _stacked(target, block + names[0], d)
    return [row for part, name in zip("qkv", names) for row in linear(target + "attn_" + part, block + name, d, d, bias=True)]


def _vision(s: Sizes, names: Names) -> List[Weight]:
    d, patch, n_position = s.d_vision, s.patch_size, (s.image_size // s.patch_size) ** 2 + 1
    source = names.vision + names.patch
    rows = [
        Weight("vision.class_token.weight", names.vision + names.class_token, VECTOR, (1, 1, d), (d,)),
        # A convolution whose stride is its kernel is a matrix over the flattened patch: channel, row, column.
        Weight("vision.patch_embed.weight", source + ".weight", MATRIX, (d, 3, patch, patch), (d, 3 * patch**2)),
        *vector("vision.patch_embed.bias", source + ".bias", d),
        Weight("vision.position.weight", names.vision + names.position, TABLE, (1, n_position, d), (n_position, d)),
    ]
    for i in range(s.n_vision_layer):
        target, block = "vision.blk.{}.".format(i), names.vision + names.block.format(i)
        rows += norm(target + "attn_norm", block + names.norms[0], d)
        rows += _qkv(target, block, names.qkv, d)
        rows += linear(target + "attn_out", block + names.out, d, d, bias=True)
        rows += vector(target + "attn_scale.weight", block + names.scales[0], d)
        rows += norm(target + "ffn_norm", block + names.norms[1], d)
        rows += linear(target + "ffn_up", block + "mlp.fc1", s.d_vision_ff, d, bias=True)
        rows += linear(target + "ffn_down", block + "mlp.fc2", d, s.d_vision_ff, bias=True)
        rows += vector(target + "ffn_scale.weight", block + names.scales[1], d)
    return rows


def _connector(s: Sizes, names: Names) -> List[Weight]:
    first, up, down = names.connector
    return [
        *norm("connector.norm", first, 4 * s.d_vision),
        *linear("connector.up", up, s.d_model, 4 * s.d_vision, bias=True),
        *linear("connector.down", down, s.d_model, s.d_model, bias=True),
    ]


def _language(s: Sizes, names: Names) -> List[Weight]:
    rows = [Weight("lm.token_embd.weight", names.lm + "embed_tokens.weight", TABLE, (s.n_vocab, s.d_model), (s.n_vocab, s.d_model))]
    d_q, d_kv = s.n_head * s.d_head, s.n_head_kv * s.d_head
    widths = {"attn_q": d_q, "attn_k": d_kv, "attn_v": d_kv}
    for i in range(s.n_layer):
        target, block = "lm.blk.{}.".format(i), "{}layers.{}.".format(names.lm, i)
        for part, parts in gated_block(target, block, s.d_model, d_q, d_kv, s.d_model, s.d_ff).items():
            rows += parts
            if part in widths:
                rows += vector(target + part + ".bias", parts[0].source[: -len("weight")] + "bias", widths[part])
    return rows + vector("lm.norm.weight", names.lm + "norm.weight", s.d_model)


def _table(target: str, source: str, n_row: int, d: int) -> Weight:
    """Sines and cosines, which are no parameters: stored in float32 they stay so, whatever the matrices are."""
    return Weight(target, source, TABLE, (1, n_row, d), (n_row, d), keep_f32=True)


def _head(s: Sizes, head: str) -> List[Weight]:
    d, encoder, out = s.d_model, head + "action_encoder.", s.horizon * s.d_action
    rows = [
        *linear("state_in", head + "state_encoder.fc1.linear", s.d_state_hidden, s.d_state, bias=True),
        *linear("state_out", head + "state_encoder.fc2.linear", d, s.d_state_hidden, bias=True),
        _table("time.weight", head + "time_pos_enc.pe", N_TIME, d),
        *linear("action_in", encoder + "W1.linear", d, s.d_action, bias=True),
        *linear("action_mix", encoder + "W2.linear", d, d, bias=True),
        *linear("action_token", encoder + "W3.linear", d, d, bias=True),
        _table("action_position.weight", encoder + "pos_encoding.pe", s.horizon, d),
    ]
    for i in range(s.n_head_layer):
        target, block = "head.blk.{}.".format(i), "{}transformer_blocks.{}.".format(head, i)
        rows += norm(target + "attn_norm", block + "norm1", d)
        rows += _stacked(target, block + "attn.in_proj_", d)
        rows += linear(target + "attn_out", block + "attn.out_proj", d, d, bias=True)
        rows += norm(target + "ffn_norm", block + "norm2", d)
        rows += linear(target + "ffn_up", block + "ff.0", 4 * d, d, bias=True)
        rows += linear(target + "ffn_down", block + "ff.2", d, 4 * d, bias=True)
    return [
        *rows,
        *norm("head.norm", head + "norm_out", d),
        *linear("pool", head + "seq_pool_proj", d, s.horizon * d, bias=True),
        *linear("velocity_in", head + "mlp_head.fc1.linear", s.d_hidden, d, bias=True),
        *linear("velocity_out", head + "mlp_head.fc2.linear", out, s.d_hidden, bias=True),
    ]

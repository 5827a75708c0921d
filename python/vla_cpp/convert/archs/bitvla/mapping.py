# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Sizes of BitVLA from config.json and the names of its tensors. An absent key has the default of the reference's own class,
listed here with the key.

Reference: BitVLA transformers (configuration_llava.py, configuration_bitnet.py, configuration_siglip.py, modeling_siglip.py),
openvla-oft/prismatic/models (action_heads.py, projectors.py).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import List

from ...bundle import Key
from ...errors import Problems
from ...files import member
from ...layers import BITNET, Rows, linear, ternary
from ...networks import (
    NORM_EPS,
    Language,
    Vision,
    check_heads,
    decoder,
    defaults,
    keys_of,
    pick,
    pooling_head,
    read_language,
    read_vision,
    siglip,
)
from ...section import Fixed, Section
from .. import Dropped, oft

WHERE = "config.json"
VISION = defaults(768, 3072, 12, 12, image_size=224, patch_size=16, layer_norm_eps=1e-6, vision_use_head=True)
# Towers with another number of bits have no ternary weights: for the reference, an absent key means 32 bits.
VISION_FIXED: Fixed = {
    "model_type": ("siglip_vision_model", "siglip_vision_model"),
    "num_channels": (3, 3),
    "hidden_act": ("gelu_pytorch_tanh", "gelu_pytorch_tanh"),
}
BITS: Fixed = {"vit_weight_bits": (32, 1), "vit_act_bits": (32, 8)}
METHODS = {"vit_weight_quant_method": "absmean", "vit_act_quant_method": "absmax_per_token"}
TEXT = defaults(
    2560, 6912, 30, 20, num_key_value_heads=5, vocab_size=128256, rms_norm_eps=1e-5, rope_theta=500000.0, max_position_embeddings=2048
)
TEXT_FIXED: Fixed = {
    "model_type": (None, "BitNet"),
    "attention_bias": (False, False),
    "rope_scaling": (None, None),
    "use_sliding_window": (False, False),
}
TOP_FIXED: Fixed = {
    "vision_feature_select_strategy": ("default", "full"),
    "projector_hidden_act": ("gelu", "gelu"),
    "multimodal_projector_bias": (True, True),
}
# Keys of transformers, of training, and keys that no forward pass reads: the language model's activation is fixed in the code.
IGNORED = set(
    """
    _name_or_path architectures auto_map model_type image_seq_length image_token_index n_action_bins norm_stats text_config torch_dtype
    transformers_version vision_config vocab_size tie_word_embeddings pad_token_id bos_token_id eos_token_id _attn_implementation_autoset
    dtype attention_dropout hidden_act initializer_range max_window_layers sliding_window use_cache head_dim
    """.split()
)


@dataclass
class Sizes:
    vision: Vision = field(default_factory=Vision)
    lm: Language = field(default_factory=Language)
    n_stored_layer: int = 0  # stored layers of the tower; only the first vision.n_layer are used
    n_context: int = 0
    d_state: int = 0
    d_action: int = 0
    horizon: int = 0
    max_views: int = 0
    stop_token: int = 0


def read_sizes(config: dict, problems: Problems) -> Sizes:
    s = Sizes()
    top = Section(WHERE, config, {"vision_feature_layer": -2}, problems)
    top.refuse_unknown({*TOP_FIXED, *IGNORED, "vision_feature_layer"})
    top.check_fixed(TOP_FIXED)
    _read_text(Section(WHERE + ": text_config", member(config, "text_config", dict, WHERE), TEXT, problems, ("num_key_value_heads",)), s)
    _read_vision(Section(WHERE + ": vision_config", member(config, "vision_config", dict, WHERE), VISION, problems), s)
    layer, n = top.get("vision_feature_layer"), s.n_stored_layer
    if not isinstance(layer, int) or isinstance(layer, bool) or not -n <= layer <= n or layer == 0:
        top.bad("vision_feature_layer", "the number of a layer's output, -{0} to {0} and not 0".format(n))
        layer = -1
    s.vision.n_layer = layer if layer > 0 else n + 1 + layer  # index 0 is the input of the first layer
    return s


def _read_text(text: Section, s: Sizes) -> None:
    text.check_fixed(TEXT_FIXED, "BitVLA's language model is BitNet b1.58")
    text.refuse_unknown({*TEXT, *TEXT_FIXED, *IGNORED})
    s.lm, s.n_context = read_language(text), text.count("max_position_embeddings")
    s.lm.rope_base, s.lm.d_head = text.number("rope_theta"), s.lm.d_model // s.lm.n_head
    check_heads(text, s.lm)
    _check_widths(text, s.lm)


def _read_vision(vision: Section, s: Sizes) -> None:
    vision.check_fixed(VISION_FIXED)
    vision.check_fixed(BITS, "a tower of other bits than the language model's 1 and 8 is not supported yet")
    vision.refuse_unknown({*VISION, *VISION_FIXED, *BITS, *METHODS, *IGNORED})
    for key, method in METHODS.items():
        vision.fixed(key, method)
    s.vision = read_vision(vision, vision.count("image_size"), vision.count("patch_size"))
    s.n_stored_layer = s.vision.n_layer
    if s.vision.image_size % s.vision.patch_size:
        vision.bad("image_size", "a multiple of patch_size {}".format(s.vision.patch_size), unsupported=True)
    _check_widths(vision, s.vision)


def _check_widths(section: Section, sizes) -> None:
    for key, width in (("hidden_size", sizes.d_model), ("intermediate_size", sizes.d_ff)):
        if width % 4:
            section.bad(key, "a multiple of 4, since four numbers share a byte", unsupported=True)


def network_keys(s: Sizes) -> List[Key]:
    return keys_of(
        {
            "policy": pick(s, "d_state d_action horizon max_views stop_token"),
            "vision": {**vars(s.vision), "position_rule": "row_major"},
            "lm": s.lm,
            "head": dict(n_layer=oft.N_HEAD_LAYER, norm_eps=NORM_EPS),
            "solver": dict(steps=1, kind="direct", noise="none"),
        }
    )


TOWER, LM, HEAD, PROPRIO = "vision_tower.vision_model.", "language_model.model.", oft.HEAD + "model.", oft.PROPRIO


def weights(s: Sizes) -> Rows:
    source, d = "multi_modal_projector.linear_", s.lm.d_model
    return [
        *_vision(s.vision),
        *linear("connector_up", source + "1", d, s.vision.d_model),
        *linear("connector_down", source + "2", d, d),
        *oft.projector("state", PROPRIO, d, s.d_state),
        *decoder(s.lm, LM, BITNET),
        *oft.head(HEAD, d, s.d_action),
    ]


def _vision(v: Vision) -> Rows:
    return siglip(TOWER, v, product=ternary, post_norm=False)


def dropped(s: Sizes) -> List[Dropped]:
    """Tensors that the policy never reads: those after the tower's last used layer, and the language head."""
    v, unread = s.vision, "features are read in front of it"
    stored = _vision(replace(v, n_layer=s.n_stored_layer))[len(_vision(v)) :]
    rows = [Dropped(row.source, row.stored, unread) for row in stored] + pooling_head(TOWER, v, unread)
    rows += [Dropped("{}post_layernorm.{}".format(TOWER, part), (v.d_model,), unread) for part in ("weight", "bias")]
    return rows + [Dropped("language_model.lm_head.weight", (s.lm.n_vocab, s.lm.d_model), "no action depends on the language head")]

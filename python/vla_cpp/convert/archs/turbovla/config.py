# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Sizes of a TurboVLA policy from its config.json and those of its backbones, with refusals of everything that the runtime does not support.

An absent key has the default of the reference's own class, listed here with the key. A checkpoint has the weights of
both backbones but not their configs: the language model's comes with its tokenizer, and this module has those of DINOv3's releases.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Sequence

from ...checkpoint import Checkpoint, find_backbone
from ...errors import Problems
from ...files import read_json
from ...lerobot import action_width, check_keys, check_widths, no_position_rule, state_width, strict_views
from ...networks import MAX_LAYERS, TextEncoder, Vision, defaults, read_vision
from ...recipe import STATE
from ...section import Section
from .. import Options

# TurboVLAConfig keys with effect on numbers, with the class's defaults.
POLICY = {
    "chunk_size": 12,
    "n_action_steps": 12,
    "vision_backbone": "facebook/dinov3-vitb16-pretrain-lvd1689m",
    "language_backbone": "google-bert/bert-base-uncased",
    "image_size": 224,
    "max_language_tokens": 32,
    "dim_model": 256,
    "n_heads": 8,
    "dim_feedforward": 1024,
    "feedforward_activation": "relu",
    "n_fusion_layers": 6,
    "n_decoder_layers": 4,
}
# Keys without effect on the numbers of an action chunk, beside those of every LeRobot policy.
IGNORED = set("load_pretrained_backbones freeze_vision_backbone freeze_language_backbone dropout optimizer_lr_backbone".split())
ACTIVATIONS = {"relu": "relu", "gelu": "gelu_erf"}
MIN_TOKENS = 3  # one word, and the tokens before and after every text


def release(d_model: int, n_layer: int, n_head: int) -> dict:
    return defaults(d_model, 4 * d_model, n_layer, n_head, model_type="dinov3_vit", num_register_tokens=4)


# Published configs of DINOv3's vision transformers with plain MLPs.
DINOV3 = {
    "facebook/dinov3-vits16-pretrain-lvd1689m": release(384, 12, 6),
    "facebook/dinov3-vitb16-pretrain-lvd1689m": release(768, 12, 12),
    "facebook/dinov3-vitl16-pretrain-lvd1689m": release(1024, 24, 16),
    "facebook/dinov3-vitl16-pretrain-sat493m": release(1024, 24, 16),
}
# DINOv3ViTConfig and BertConfig, with the classes' defaults. Keys that they do not read have no effect in the reference either.
VISION = defaults(384, 1536, 12, 6, patch_size=16, layer_norm_eps=1e-5, rope_theta=100.0, num_register_tokens=0)
VISION_FIXED = {
    "model_type": (None, "dinov3_vit"),
    "hidden_act": ("gelu", "gelu"),
    "num_channels": (3, 3),
    "query_bias": (True, True),
    "key_bias": (False, False),
    "value_bias": (True, True),
    "proj_bias": (True, True),
    "mlp_bias": (True, True),
    "use_gated_mlp": (False, False),
}
TEXT = defaults(768, 3072, 12, 12, vocab_size=30522, max_position_embeddings=512, type_vocab_size=2, layer_norm_eps=1e-12)
TEXT_FIXED = {
    "model_type": (None, "bert"),
    "hidden_act": ("gelu", "gelu"),
    "position_embedding_type": ("absolute", "absolute"),
    "is_decoder": (False, False),
}


@dataclass
class Sizes:
    views: Sequence[str]
    d_state: int  # 0: the policy reads none
    d_action: int
    horizon: int
    max_tokens: int
    d_model: int
    n_head: int
    d_ff: int
    activation: str
    n_fusion: int
    n_decoder: int
    vision: Vision
    rope_base: float
    n_register: int
    lm: TextEncoder
    n_sentence: int  # rows of the table of sentence types (BERT's token_type_embeddings)
    lm_folder: str


def read_sizes(checkpoint: Checkpoint, options: Options, problems: Problems) -> Sizes:
    policy = Section("config.json", checkpoint.config, POLICY, problems)
    no_position_rule(policy, options, problems)
    check_keys(policy, "TurboVLAConfig", set(POLICY) | IGNORED, {})
    check_widths(policy, {})
    activation = policy.get("feedforward_activation")
    if activation not in ACTIVATIONS:
        policy.bad("feedforward_activation", " or ".join(ACTIVATIONS))
    folder = find_backbone(checkpoint, options.backbone, policy.get("language_backbone"), "language_backbone", "language_encoder")
    text = Section("backbone config.json", read_json(os.path.join(folder, "config.json")), TEXT, problems)
    text.check_fixed(TEXT_FIXED, "the runtime's language model of this policy is BERT")
    vision = Section("config of vision_backbone", _vision_config(policy, checkpoint), VISION, problems)
    vision.check_fixed(VISION_FIXED, "the runtime implements DINOv3's vision transformers with plain MLPs")
    features = policy.get("input_features")
    has_state = isinstance(features, dict) and STATE in features
    s = Sizes(
        views=strict_views(policy),
        d_state=state_width(policy, checkpoint, options, padded=False) if has_state else 0,
        d_action=action_width(policy, checkpoint, options),
        horizon=policy.count("chunk_size", maximum=4096),
        max_tokens=policy.count("max_language_tokens", MIN_TOKENS, text.count("max_position_embeddings")),
        d_model=policy.count("dim_model"),
        n_head=policy.count("n_heads"),
        d_ff=policy.count("dim_feedforward"),
        activation=ACTIVATIONS.get(activation, "relu"),
        n_fusion=policy.count("n_fusion_layers", maximum=MAX_LAYERS),
        n_decoder=policy.count("n_decoder_layers", maximum=MAX_LAYERS),
        vision=read_vision(vision, policy.count("image_size"), vision.count("patch_size")),
        rope_base=vision.number("rope_theta"),
        n_register=vision.count("num_register_tokens", 0, 1023),
        lm=read_bert(text),
        n_sentence=text.count("type_vocab_size"),
        lm_folder=folder,
    )
    if s.d_model % s.n_head:
        policy.bad("n_heads", "a divisor of dim_model {}".format(s.d_model))
    if s.vision.image_size % s.vision.patch_size:
        policy.bad("image_size", "a multiple of patch_size {}".format(s.vision.patch_size))
    if s.vision.d_model % (4 * s.vision.n_head):
        vision.bad("num_attention_heads", "heads of a multiple of 4, for the rotary embedding")
    return s


def _vision_config(policy: Section, checkpoint: Checkpoint) -> dict:
    """The vision backbone's config: that in vision_encoder/ inside the checkpoint, else that of the named release."""
    path = checkpoint.path(os.path.join("vision_encoder", "config.json"))
    if os.path.exists(path):
        checkpoint.notes.append("config of the vision backbone: from vision_encoder/ inside the checkpoint")
        return read_json(path)
    name = policy.get("vision_backbone")
    if isinstance(name, str) and name in DINOV3:
        return DINOV3[name]
    hint = "put the config.json of another DINOv3 into vision_encoder/ of the checkpoint"
    policy.bad("vision_backbone", " or ".join(DINOV3), hint=hint, unsupported=True)
    return release(768, 12, 12)


def read_bert(text: Section) -> TextEncoder:
    bert = TextEncoder(
        d_model=text.count("hidden_size"),
        n_layer=text.count("num_hidden_layers", maximum=MAX_LAYERS),
        n_head=text.count("num_attention_heads"),
        d_ff=text.count("intermediate_size"),
        n_vocab=text.count("vocab_size"),
        n_position=text.count("max_position_embeddings"),
        norm_eps=text.number("layer_norm_eps"),
    )
    if bert.d_model % bert.n_head:
        text.bad("num_attention_heads", "a divisor of hidden_size {}".format(bert.d_model))
    return bert

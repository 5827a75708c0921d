// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>

#include "modules/attention.h"
#include "nn/mlp.h"

namespace vla {

/// The options in which encoder families differ.
struct EncoderFamily {
  Activation activation;  // activation of the MLP
  bool scaled;            // attention and MLP are scaled feature by feature before they are added (LayerScale)
  Rule rule = Rule::floats;
  bool plain_keys = false;  // keys have no bias
};
constexpr EncoderFamily kPlainEncoder = {Activation::gelu_tanh, false};
constexpr EncoderFamily kInternEncoder = {Activation::gelu_erf, true};
constexpr EncoderFamily kDinoEncoder = {Activation::gelu_erf, true, Rule::floats, true};
constexpr EncoderFamily kTernaryEncoder = {Activation::gelu_tanh, false, Rule::int8_rows};

/// FiLM: x * (1 + scale) + shift, the same for all tokens, both linear in a condition. The 1 is part of the bundle's
/// bias of `film_scale`. Source: openvla-oft prismatic/models/film_vit_wrapper.py FiLMedVisionTransformerBlock.
class Film {
 public:
  Film(const Scope& s, int d_condition, int d_model);
  /// x [d_model, n, n_view], condition [d_condition, 1] -> the shape of x.
  Tensor operator()(Graph& g, Tensor x, Tensor condition) const;

 private:
  Linear scale_, shift_;
};

/// One pre-norm encoder layer: attention in which all tokens of a view see each other, then a GELU MLP.
/// Sources: transformers modeling_siglip.py SiglipEncoderLayer, modeling_qwen3_vl.py Qwen3VLVisionBlock,
/// modeling_dinov3_vit.py DINOv3ViTLayer; InternVL
/// internvl_chat/internvl/model/internvl_chat/modeling_intern_vit.py InternVisionEncoderLayer; lerobot
/// policies/groot/action_head/cross_attention_dit.py BasicTransformerBlock (layer_norm); BitVLA modeling_siglip.py
/// SiglipEncoderLayer (ternary weights).
class EncoderBlock : public Module<EncoderBlock> {
 public:
  /// `d_condition`: width of the FiLM condition, 0 without FiLM. FiLM acts between attention and MLP.
  EncoderBlock(const Scope& s, int d_model, int n_head, int d_ff, float eps, EncoderFamily family = kPlainEncoder,
               int d_condition = 0);
  /// x [d_model, n, n_view] -> the same shape; `rotary` [d_head, n] rotates queries and keys, or none; `condition`
  /// [d_condition, 1] of FiLM, or none.
  Tensor forward(Graph& g, Tensor x, Tensor rotary = {}, Tensor condition = {}) const;

 private:
  LayerNorm attn_norm_;
  Attention attention_;
  std::optional<Film> film_;
  LayerNorm ffn_norm_;
  Mlp mlp_;
  const Param* attn_scale_ = nullptr;  // only with LayerScale
  const Param* ffn_scale_ = nullptr;
};

}  // namespace vla

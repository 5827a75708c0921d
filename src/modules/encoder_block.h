// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "nn/mlp.h"
#include "nn/norm.h"

namespace vla {

/// One pre-norm encoder layer: attention in which all tokens of a view see each other, then a GELU MLP.
/// Sources: transformers modeling_siglip.py SiglipEncoderLayer, modeling_qwen3_vl.py Qwen3VLVisionBlock; lerobot
/// policies/groot/action_head/cross_attention_dit.py BasicTransformerBlock (layer_norm).
class EncoderBlock : public Module<EncoderBlock> {
 public:
  EncoderBlock(const Scope& s, int d_model, int n_head, int d_ff, float eps);
  /// x [d_model, n, n_view] -> the same shape; `rotary` turns queries and keys [d_head, n], or none.
  Tensor forward(Graph& g, Tensor x, Tensor rotary = {}) const;

 private:
  int n_head_;
  LayerNorm attn_norm_;
  Linear q_, k_, v_, out_;
  LayerNorm ffn_norm_;
  Mlp mlp_;
};

}  // namespace vla

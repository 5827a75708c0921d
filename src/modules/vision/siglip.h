// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <vector>

#include "nn/embedding.h"
#include "nn/linear.h"
#include "nn/mlp.h"
#include "nn/norm.h"

namespace vla {

/// One pre-norm block: full attention with biases, then a GELU MLP. x [d_model, n_patch, n_view] -> the same shape.
/// Source: transformers modeling_smolvlm.py SmolVLMEncoderLayer.
class SiglipBlock : public Module<SiglipBlock> {
 public:
  SiglipBlock(const Scope& s, int d_model, int n_head, int d_ff, float eps);
  Tensor forward(Graph& g, Tensor x) const;

 private:
  int n_head_;
  LayerNorm attn_norm_;
  Linear q_, k_, v_, out_;
  LayerNorm ffn_norm_;
  Mlp mlp_;
};

/// The vision tower of the SigLIP family, every view in one batch. Source: transformers modeling_smolvlm.py
/// SmolVLMVisionTransformer.
class Siglip {
 public:
  explicit Siglip(const Scope& s);

  /// images [width, height, 3, n_view] in [-1, 1] -> [d_model, n_patch, n_view]. `check` must have accepted the size.
  Tensor operator()(Graph& g, Tensor images) const;
  /// Whether pictures of this size have defined patches and positions. Errors: bad_bundle, unsupported.
  Status check(int width, int height) const;

  int d_model() const { return d_model_; }
  int patch_size() const { return patch_size_; }

 private:
  int n_position() const { return n_table_ * n_table_; }

  int d_model_, patch_size_, n_table_;
  std::string position_rule_;
  PatchEmbed patch_embed_;
  Embedding position_;
  std::vector<SiglipBlock> blocks_;
  LayerNorm post_norm_;
};

}  // namespace vla

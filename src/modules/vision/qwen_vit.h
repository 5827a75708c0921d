// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vector>

#include "graph/cache.h"
#include "modules/encoder_block.h"
#include "nn/embedding.h"
#include "nn/linear.h"
#include "nn/rope.h"

namespace vla {

/// Qwen3-VL's vision tower on single images, all views in one batch. An image is treated as two equal frames, each with
/// its own patch projection. Patches are ordered in squares of merge x merge; their places enter by a learned table and
/// by rotary embedding. There is no final norm. Source: transformers modeling_qwen3_vl.py Qwen3VLVisionModel.
class QwenVit {
 public:
  explicit QwenVit(const Scope& s);

  /// Load rate: interpolates the position table for the image size into the cache.
  void keep(Graph& g, Cache& cache) const;
  /// images [width, height, 3, n_view] in [-1, 1] -> the results of `deepstack_layers` and then of the last layer,
  /// [d_model, n_patch, n_view] each.
  std::vector<Tensor> operator()(Graph& g, Tensor images, const Cache& cache) const;
  /// Checks that images have the size of the keys. Errors: unsupported.
  Status check(int width, int height) const;

  int d_model() const { return d_model_; }
  float norm_eps() const { return norm_eps_; }
  /// The number of patches that become one token.
  int n_merged() const { return merge_ * merge_; }
  /// Tokens of a view: rows and columns.
  int n_token_row() const { return n_row_ / merge_; }
  int n_token_column() const { return n_column_ / merge_; }
  int n_deepstack() const { return static_cast<int>(deepstack_layers_.size()); }

 private:
  std::vector<PositionId> places() const;

  int d_model_, n_head_, width_, height_, patch_size_, merge_, n_row_, n_column_, n_side_;
  float norm_eps_, rope_base_;
  std::vector<int> deepstack_layers_;
  Linear patch_embed_, patch_embed_next_;
  Embedding position_;
  std::vector<EncoderBlock> blocks_;
};

}  // namespace vla

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

/// The vision tower of Qwen3-VL on single images, every view in one batch. An image is treated as two frames that are
/// the same, and each has a patch product of its own. Patches come in squares of merge x merge, one square after the
/// other; they know their place by a learned table and by turning. There is no final norm.
/// Source: transformers modeling_qwen3_vl.py Qwen3VLVisionModel.
class QwenVit {
 public:
  explicit QwenVit(const Scope& s);

  /// Load rate: the position table stretched over the image, into the cache.
  void keep(Graph& g, Cache& cache) const;
  /// images [width, height, 3, n_view] in [-1, 1] -> what each of `deepstack_layers` and then the last layer gives,
  /// [d_model, n_patch, n_view] each.
  std::vector<Tensor> operator()(Graph& g, Tensor images, const Cache& cache) const;
  /// Images have one size. Errors: unsupported.
  Status check(int width, int height) const;

  int d_model() const { return d_model_; }
  float norm_eps() const { return norm_eps_; }
  /// Patches that become one token.
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

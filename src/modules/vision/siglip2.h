// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vector>

#include "graph/cache.h"
#include "modules/encoder_block.h"
#include "nn/embedding.h"

namespace vla {

/// The vision tower of SigLIP 2 on images of any aspect, every view in one batch: its position table is resized to
/// the patches of an image. Source: transformers modeling_siglip2.py Siglip2VisionTransformer.
class Siglip2 {
 public:
  explicit Siglip2(const Scope& s);

  /// Load rate: resizes the position table into the cache.
  void keep(Graph& g, Cache& cache) const;
  /// images [width, height, 3, n_view] in [-1, 1] -> [d_model, n_patch, n_view], patches row by row.
  Tensor operator()(Graph& g, Tensor images, const Cache& cache) const;
  /// Checks that images have the size of the keys. Errors: unsupported.
  Status check(int width, int height) const;

  int d_model() const { return d_model_; }
  int n_row() const { return height_ / patch_size_; }
  int n_column() const { return width_ / patch_size_; }

 private:
  int d_model_, width_, height_, patch_size_, n_side_;
  PatchEmbed patch_embed_;
  Embedding position_;
  std::vector<EncoderBlock> blocks_;
  LayerNorm post_norm_;
};

}  // namespace vla

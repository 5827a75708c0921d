// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vector>

#include "modules/encoder_block.h"
#include "nn/embedding.h"

namespace vla {

/// InternViT, the vision tower of InternVL, every view in one batch. A class token precedes the patches and
/// is dropped at the end; there is no final norm. Source: InternVL
/// internvl_chat/internvl/model/internvl_chat/modeling_intern_vit.py InternVisionModel.
class InternVit {
 public:
  explicit InternVit(const Scope& s);

  /// images [side, side, 3, n_view], standardized -> [d_model, n_patch, n_view]. `check` must have accepted the size.
  Tensor operator()(Graph& g, Tensor images) const;
  /// Checks that images fit the position table; the reference's interpolation for other sizes is not implemented.
  /// Errors: unsupported.
  Status check(int width, int height) const;

  int d_model() const { return d_model_; }
  int image_size() const { return image_size_; }
  /// Patches per image row.
  int n_side() const { return n_side_; }

 private:
  int d_model_, image_size_, n_side_;
  const Param* class_token_;
  PatchEmbed patch_embed_;
  Embedding position_;
  std::vector<EncoderBlock> blocks_;
};

}  // namespace vla

// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "modules/encoder_block.h"
#include "nn/embedding.h"

namespace vla {

/// DINOv2's vision transformer, all views in one batch, up to the block whose patches a policy reads. A class token and
/// registers precede the patches, have no position, and are dropped at the end. Source: timm vision_transformer.py
/// VisionTransformer (reg_tokens, no_embed_class), get_intermediate_layers.
class DinoV2 {
 public:
  /// `d_condition`: width of the FiLM condition of all blocks, 0 without FiLM.
  explicit DinoV2(const Scope& s, int d_condition = 0);

  /// images [side, side, 3, n_view], standardized, condition [d_condition, 1] or none -> [d_model, n_patch, n_view].
  /// `check` must have accepted the size.
  Tensor operator()(Graph& g, Tensor images, Tensor condition = {}) const;
  /// Checks that images have the size of the keys. Errors: unsupported.
  Status check(int width, int height) const;

  int d_model() const { return d_model_; }
  /// Patches of a view.
  int n_patch() const { return n_side_ * n_side_; }

 private:
  std::string path_;
  int d_model_, image_size_, n_side_, n_register_;
  const Param* class_token_;
  PatchEmbed patch_embed_;
  Embedding position_;
  std::optional<Embedding> registers_;
  std::vector<EncoderBlock> blocks_;
};

}  // namespace vla

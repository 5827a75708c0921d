// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "modules/encoder_block.h"
#include "nn/embedding.h"

namespace vla {

/// The vision tower of the SigLIP family, every view in one batch. Source: transformers modeling_smolvlm.py
/// SmolVLMVisionTransformer.
class Siglip {
 public:
  /// `post_norm`: features are read after a final norm, else after the last layer. `d_condition`: width of the FiLM
  /// condition of all blocks, 0 without FiLM.
  explicit Siglip(const Scope& s, EncoderFamily family = kPlainEncoder, bool post_norm = true, int d_condition = 0);

  /// images [width, height, 3, n_view] in [-1, 1], condition [d_condition, 1] or none -> [d_model, n_patch, n_view].
  /// `check` must have accepted the size.
  Tensor operator()(Graph& g, Tensor images, Tensor condition = {}) const;
  /// Checks that patches and positions are defined for images of this size. Errors: bad_bundle, unsupported.
  Status check(int width, int height) const;

  int d_model() const { return d_model_; }
  int patch_size() const { return patch_size_; }
  /// Rows of the position table: patches of an image of `image_size`.
  int n_position() const { return n_table_ * n_table_; }

 private:
  int d_model_, patch_size_, n_table_;
  std::string position_rule_;
  PatchEmbed patch_embed_;
  Embedding position_;
  std::vector<EncoderBlock> blocks_;
  std::optional<LayerNorm> post_norm_;
};

}  // namespace vla

// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <vector>

#include "modules/encoder_block.h"
#include "nn/embedding.h"

namespace vla {

/// DINOv3's vision transformer, all views in one batch. A class token and registers precede the patches and are dropped
/// at the end; only patches get a rotary embedding of their place. Source: transformers modeling_dinov3_vit.py
/// DINOv3ViTModel.
class DinoV3 {
 public:
  /// `normed`: whether the patches pass the tower's final norm; otherwise they are the last block's output.
  explicit DinoV3(const Scope& s, bool normed = true);

  /// images [side, side, 3, n_view], standardized -> [d_model, n_patch, n_view]. `check` must have accepted the size.
  Tensor operator()(Graph& g, Tensor images) const;
  /// Checks that images have the size of the keys. Errors: unsupported.
  Status check(int width, int height) const;

  int d_model() const { return d_model_; }
  /// Patches of a view.
  int n_patch() const { return n_side_ * n_side_; }

 private:
  int d_model_, n_head_, image_size_, n_side_, n_register_;
  float rope_base_;
  const Param* class_token_;
  PatchEmbed patch_embed_;
  std::optional<Embedding> registers_;
  std::vector<EncoderBlock> blocks_;
  std::optional<LayerNorm> post_norm_;
};

}  // namespace vla

// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <vector>

#include "modules/encoder_block.h"
#include "nn/embedding.h"

namespace vla {

/// The vision transformers of DINOv3, every view in one batch. A class token and registers precede the patches and are
/// dropped at the end; patches know their place by turning, and those tokens do not turn.
/// Source: transformers modeling_dinov3_vit.py DINOv3ViTModel.
class DinoV3 {
 public:
  explicit DinoV3(const Scope& s);

  /// images [side, side, 3, n_view], standardized -> [d_model, n_patch, n_view]. `check` must have accepted the size.
  Tensor operator()(Graph& g, Tensor images) const;
  /// Images have one size. Errors: unsupported.
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
  LayerNorm post_norm_;
};

}  // namespace vla

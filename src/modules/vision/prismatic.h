// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "modules/vision/dinov2.h"
#include "modules/vision/siglip.h"
#include "nn/linear.h"

namespace vla {

/// The image side of a Prismatic VLM: patch features of DINOv2 and SigLIP, concatenated, and an MLP of three layers to
/// the language model's width. Both towers end before their last block. Reads `dino`, `siglip` and `lm.d_model` of the
/// root. Source: openvla prismatic/extern/hf/modeling_prismatic.py (PrismaticVisionBackbone, PrismaticProjector).
class PrismaticVision {
 public:
  /// `d_condition`: width of the FiLM condition of all blocks, 0 without FiLM.
  explicit PrismaticVision(const Scope& s, int d_condition = 0);

  /// images [side, side, 3, n_view] from 0 to 1, condition [d_condition, 1] or none -> [d_model, n_patch * n_view]. The
  /// towers' pixel means and standard deviations are folded into their first products. Ends stage `vision`.
  Tensor operator()(Graph& g, Tensor images, Tensor condition = {}) const;
  /// Checks that images have the size of the keys, and that a prompt has tokens before and after the images. Errors:
  /// bad_bundle, bad_observation, unsupported.
  Status check(int width, int height, int n_text) const;

  /// Patches of a view.
  int n_patch() const { return dino_.n_patch(); }

 private:
  DinoV2 dino_;
  Siglip siglip_;
  int d_patch_, d_model_;
  Linear projector_up_, projector_mid_, projector_down_;
};

/// The keys `own` of a policy, and the keys of the towers and the Llama 2 of openvla/openvla-7b. Source: openvla
/// prismatic/extern/hf/configuration_prismatic.py, timm vit_large_patch14_reg4_dinov2 and
/// vit_so400m_patch14_siglip_224.
Keys prismatic_published(std::map<std::string, Value, std::less<>> own);

}  // namespace vla

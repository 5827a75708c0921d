// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <span>
#include <string>
#include <vector>

#include "base/result.h"
#include "processor/image.h"
#include "processor/ops/op.h"

namespace vla {

/// A size, without keeping the aspect, by `resample_torch_cubic` or `resample_torch_area`.
struct FloatResize {
  enum class Filter { bicubic, area };

  int width = 0;
  int height = 0;
  Filter filter = Filter::bicubic;
};

/// Frames to one size after the other, in floats; the last is the network's.
struct FloatResizes {
  std::optional<CameraSize> camera;  // the only frames that are taken, where their size decides that of the images
  std::vector<FloatResize> sizes;
};

/// Writes (3, height, width) float32 to `out`, bytes divided by 255 before anything else; bicubic edges may leave
/// [0, 1]. An image that has a size already is not resampled. Source: lerobot policies/vla_jepa/modeling_vla_jepa.py
/// (VLAJEPAModel.predict_action); transformers models/qwen2_vl/image_processing_qwen2_vl.py, of float tensors.
/// Errors: bad_observation.
Status resize_floats(const Frame& frame, const FloatResizes& to, std::span<float> out, const std::string& where);

}  // namespace vla

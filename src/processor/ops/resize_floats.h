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
#include "processor/ops/resize.h"

namespace vla {

/// Resizes float frames to several sizes in turn, with filters on floats, and crops the result. The final size is the
/// network's.
struct FloatResizes {
  std::optional<CameraSize> camera;  // the only frame size accepted, if it determines the images' size
  std::vector<Resize> sizes;
  std::optional<CameraSize> crop;  // centre of the last size; half of the margin is rounded to even
};

/// Writes (3, height, width) float32 to `out`; bytes are divided by 255 first. Bicubic edges may leave [0, 1]. A resize
/// to the image's own size does nothing. Source: lerobot policies/vla_jepa/modeling_vla_jepa.py
/// (VLAJEPAModel.predict_action); transformers models/qwen2_vl/image_processing_qwen2_vl.py, for float tensors;
/// torchvision transforms/functional.py center_crop. Errors:
/// bad_observation.
Status resize_floats(const Frame& frame, const FloatResizes& to, std::span<float> out, const std::string& where);

}  // namespace vla

// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>
#include <string>

#include "base/result.h"
#include "processor/image.h"

namespace vla {

/// Resizes a frame to `width` x `height` without keeping its aspect, with one reference's arithmetic.
struct Resize {
  enum class Filter { opencv_bilinear, torch_bicubic_8bit, torch_bilinear };

  int width = 0;
  int height = 0;
  Filter filter = Filter::opencv_bilinear;
};

/// Writes (3, height, width) float32 to `out`: the resized bytes divided by 255, or for torch_bilinear, without
/// antialiasing, what is divided first. A frame that has the size already is not resampled. Pixels as floats are cut to
/// bytes by torch_bicubic_8bit (255 x, without rounding), as its reference cuts them; opencv_bilinear refuses them,
/// since its reference gets bytes only. Source: `resample_opencv`, `resample_torch`, `stretch`; lerobot
/// policies/evo1/internvl3_embedder.py (_batched_resize_01); lerobot_policy_turbovla modeling_turbovla.py
/// (TurboVLA._encode_images). Errors: bad_observation.
Status resize(const Frame& frame, const Resize& to, std::span<float> out, const std::string& where);

}  // namespace vla

// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <span>

namespace vla {

/// `(x - mean) / std` of each channel of a picture.
struct Standardize {
  /// float32; every number and result rounded to bfloat16; or only the last result of float32.
  enum class Arithmetic { float32, bfloat16, float32_then_bfloat16 };

  std::array<float, 3> mean{}, std{};  // red, green, blue
  Arithmetic arithmetic = Arithmetic::float32;
};

/// In place, on planes (3, height, width). Source: lerobot policies/evo1/internvl3_embedder.py
/// (_batched_pixel_values), torch's element-wise arithmetic.
void standardize(std::span<float> pixels, const Standardize& op);

}  // namespace vla

// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <span>

namespace vla {

/// `(x - mean) / std` of each channel of an image.
struct Standardize {
  /// bfloat16: every value and result is rounded to bfloat16. float32_then_bfloat16: only the final result is rounded.
  /// float32_in_bytes: x, mean and std are multiplied by 255, so that no division by 255 rounds.
  enum class Arithmetic { float32, bfloat16, float32_then_bfloat16, float32_in_bytes };

  std::array<float, 3> mean{}, std{};  // red, green, blue
  Arithmetic arithmetic = Arithmetic::float32;
};

/// In place, on planes (3, height, width). Source: lerobot policies/evo1/internvl3_embedder.py (_batched_pixel_values),
/// torch's element-wise arithmetic; in bytes: transformers image_processing_utils_fast.py
/// (_fuse_mean_std_and_rescale_factor).
void standardize(std::span<float> pixels, const Standardize& op);
/// The same for values of one channel.
void standardize(std::span<float> plane, std::size_t channel, const Standardize& op);

/// `x * scale + shift`, each rounded to float32, in place.
void affine(std::span<float> values, float scale, float shift);

/// Clamps every value to [low, high], in place. Interpolation can leave its inputs' range by a rounding error.
void clip(std::span<float> values, float low, float high);

}  // namespace vla

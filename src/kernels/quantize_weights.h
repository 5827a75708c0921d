// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <limits>

#include "kernels/numbers.h"

namespace vla::kernels {

/// A matrix of floats as int8: the greatest number of a row of W becomes 127, and scale * code is nearly the number.
/// A row with a number that is not finite gets a scale that makes its products not finite.
/// stored: d_out rows of d_in numbers; codes the same in bytes; scales [d_out]; row: room for d_in numbers.
template <DType kType>
void quantize_weights(const std::byte* stored, std::int64_t d_in, std::int64_t d_out, std::byte* codes, float* scales,
                      float* row) {
  constexpr float kLeast = 1e-30f;     // 127 / most is finite; numbers below it are as good as zero
  constexpr float kRound = 0x1.8p23f;  // adding it leaves a whole number in the lowest bits, ties to even
  constexpr std::int32_t kInfinity = 0x7f800000;
  for (std::int64_t n = 0; n < d_out; ++n, stored += d_in * number_size(kType), codes += d_in) {
    std::int32_t most = 0;  // without their signs, floats are ordered as whole numbers are, and NaN is above them all
    for (std::int64_t k = 0; k < d_in; ++k) {
      row[k] = stored_number(kType, stored, k);
      const std::int32_t size = std::bit_cast<std::int32_t>(row[k]) & 0x7fffffff;
      most = size > most ? size : most;
    }
    const bool is_finite = most < kInfinity;
    const float a = is_finite ? std::bit_cast<float>(most) : 0, s = a > kLeast ? 127 / a : 0;
    scales[n] = !is_finite ? std::numeric_limits<float>::quiet_NaN() : s > 0 ? a / 127 : 0;
    for (std::int64_t k = 0; k < d_in; ++k)
      codes[k] = s > 0 ? static_cast<std::byte>(std::bit_cast<std::int32_t>(row[k] * s + kRound)) : std::byte{0};
  }
}

inline void quantize_weights(DType type, const std::byte* stored, std::int64_t d_in, std::int64_t d_out,
                             std::byte* codes, float* scales, float* row) {
  const auto quantize = type == DType::f32   ? quantize_weights<DType::f32>
                        : type == DType::f16 ? quantize_weights<DType::f16>
                                             : quantize_weights<DType::bf16>;
  quantize(stored, d_in, d_out, codes, scales, row);
}

}  // namespace vla::kernels

// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "kernels/linear_loop.h"

/// What tiles of bf16 pairs share: numbers, panels and blocks of x.
namespace vla::kernels {

VLA_INLINE float from_bf16(std::uint16_t x) { return std::bit_cast<float>(std::uint32_t{x} << 16); }

/// To the nearest bf16, ties to even, as PyTorch rounds; a NaN stays one.
VLA_INLINE std::uint16_t to_bf16(float x) {
  const auto bits = std::bit_cast<std::uint32_t>(x);
  if ((bits & 0x7fffffffU) > 0x7f800000U) return static_cast<std::uint16_t>(bits >> 16 | 64U);
  return static_cast<std::uint16_t>((bits + 0x7fffU + (bits >> 16 & 1U)) >> 16);
}

VLA_INLINE float from_f16(std::uint16_t x) {
  const std::uint32_t sign = std::uint32_t{x & 0x8000U} << 16, exponent = x >> 10 & 31U, fraction = x & 1023U;
  if (exponent == 31) return std::bit_cast<float>(sign | 0x7f800000U | fraction << 13);
  if (exponent != 0) return std::bit_cast<float>(sign | (exponent + 112) << 23 | fraction << 13);
  const float small = static_cast<float>(fraction) * 0x1p-24f;
  return sign != 0 ? -small : small;
}

/// Number i of a stored matrix.
VLA_INLINE float stored_number(DType type, const std::byte* stored, std::int64_t i) {
  if (type == DType::f32) {
    float x;
    std::memcpy(&x, stored + 4 * i, sizeof(x));
    return x;
  }
  std::uint16_t x;
  std::memcpy(&x, stored + 2 * i, sizeof(x));
  return type == DType::bf16 ? from_bf16(x) : from_f16(x);
}

/// Panels of 32 columns for tiles of 16 by 16 words: for each 32 of the depth two tiles of 16 columns, and in each of
/// their 16 lines one pair of consecutive numbers of every column. x is rounded to bf16.
struct PairPanels {
  using X = std::uint16_t;
  static constexpr int kRows = 32, kColumns = 32, kDepth = 32;
  static constexpr int kMaxDepth = 1536, kBlockRows = 256, kBlockColumns = 2048, kXStride = kMaxDepth + 32;
  static constexpr int kPackCost = 1, kCopyCost = 3;
  static constexpr bool kPacked = true, kEven = false;

  static VLA_INLINE std::size_t panel_size(DType, std::int64_t depth) {
    return static_cast<std::size_t>(depth) * kColumns * sizeof(std::uint16_t);
  }

  /// Where number k of column n stands in a panel.
  static VLA_INLINE std::int64_t place(std::int64_t k, std::int64_t n) {
    return k / 32 * 1024 + n / 16 * 512 + k % 32 / 2 * 32 + n % 16 * 2 + k % 2;
  }

  static VLA_INLINE void pack(DType, const std::byte* rows, std::int64_t d_in, std::int64_t n_column,
                              std::int64_t depth, std::byte* panel) {
    std::memset(panel, 0, panel_size(DType::bf16, round_up(depth, kDepth)));
    auto* out = reinterpret_cast<std::uint16_t*>(panel);
    for (std::int64_t n = 0; n < n_column; ++n) {
      const std::byte* row = rows + n * d_in * 2;
      std::int64_t k = 0;
      for (; k + 2 <= depth; k += 2) std::memcpy(out + place(k, n), row + 2 * k, 4);
      if (k < depth) std::memcpy(out + place(k, n), row + 2 * k, 2);
    }
  }

  static VLA_INLINE void copy(const float* from, std::int64_t n, std::uint16_t* to) {
    for (std::int64_t i = 0; i < n; ++i) to[i] = to_bf16(from[i]);
    for (std::int64_t i = n; i % kDepth != 0; ++i) to[i] = 0;
  }
};

}  // namespace vla::kernels

// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <bit>
#include <cstddef>

#include "kernels/sizes.h"
#include "kernels/vec.h"

/// Rows of x as int8 codes, as products of ternary, int4 and int8 matrices read them: d_in codes, padded with zeros to
/// a multiple of 64, then 64 bytes that begin with the row's scale.
namespace vla::kernels {

constexpr std::int64_t kQuantizedUnit = 64;
/// A tile may read this many rows, even if x has fewer, so memory must follow the last row.
constexpr int kMaxTernaryRows = 32;

/// The largest depth for kernels that copy rows.
constexpr std::int64_t kMaxPairedDepth = 32768;

/// Codes of a row with their padding.
constexpr VLA_INLINE std::int64_t quantized_depth(std::int64_t d_in) { return round_up(d_in, kQuantizedUnit); }
/// Bytes from one row to the next.
constexpr VLA_INLINE std::int64_t quantized_stride(std::int64_t d_in) { return quantized_depth(d_in) + kQuantizedUnit; }

/// Bytes of n_row rows, including those that a tile may read after the last row.
constexpr VLA_INLINE std::int64_t quantized_size(std::int64_t n_row, std::int64_t d_in) {
  return (n_row + kMaxTernaryRows - 1) * quantized_stride(d_in);
}

/// x is code / s. `sum` is the sum of the codes: the offset of weights (int8_panels.h) adds offset * sum to each
/// product.
struct RowScale {
  float s;
  std::int32_t sum;
};

VLA_INLINE RowScale row_scale(const std::byte* row, std::int64_t d_in) {
  RowScale scale;
  std::memcpy(&scale, row + quantized_depth(d_in), sizeof(scale));
  return scale;
}

/// s = (1 / a) * 127 with a = max |x|, at least 1e-5, in two roundings; code = x * s rounded to nearest, ties to even,
/// so a becomes 127. A row with a value that is not finite gets a scale that makes its products not finite. Files that
/// include this must be compiled with -ffp-contract=off, because x * s is rounded before it becomes an integer. Source:
/// BitVLA modeling_bitnet.py ActQuant; torch computes 127 / a as here.
template <class V>
VLA_INLINE void quantize_row(const float* x, std::int64_t n, std::byte* to) {
  using Float = typename V::Float;
  using Int = typename V::Int;
  // The bits of |x| have the order of the floats, with NaN above all.
  Int most = {};
  for (std::int64_t i = 0; i < n; i += V::width) {
    const Int size = std::bit_cast<Int>(load<V>(x + i, n - i)) & 0x7fffffff;
    most = size > most ? size : most;
  }
  std::int32_t largest = 0;
  for (int lane = 0; lane < V::width; ++lane) largest = most[lane] > largest ? most[lane] : largest;
  const auto a = std::bit_cast<float>(largest);
  RowScale scale = {1.0f / (a < 1e-5f ? 1e-5f : a) * 127.0f, 0};

  constexpr float kRound = 0x1.8p23f;  // adding this constant leaves an integer in the lowest bits, ties to even
  typedef signed char Codes __attribute__((vector_size(V::width)));
  Int sum = {};
  for (std::int64_t i = 0; i < n; i += V::width) {
    const Float rounded = load<V>(x + i, n - i) * scale.s + kRound;
    const Int code = std::bit_cast<Int>(rounded) << 24 >> 24;
    sum += code;
    const Codes codes = __builtin_convertvector(code, Codes);
    std::memcpy(to + i, &codes, sizeof(codes));  // lanes after n are zeros; there is memory for them
  }
  for (int lane = 0; lane < V::width; ++lane) scale.sum += sum[lane];
  const std::int64_t end = round_up(n, V::width);
  std::memset(to + end, 0, static_cast<std::size_t>(quantized_stride(n) - end));
  std::memcpy(to + quantized_depth(n), &scale, sizeof(scale));
}

}  // namespace vla::kernels

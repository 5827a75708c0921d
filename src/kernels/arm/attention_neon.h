// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "kernels/arm/neon_multiply_add.h"
#include "kernels/attention_products.h"

namespace vla::kernels {

/// Float32 products of 6 rows by four vectors. One load reads four elements of a row; a multiply-add selects one of
/// them by lane.
struct NeonProducts : FloatProducts<Neon, 6, 4> {
  static constexpr int kMinPanel = kPanel, kDepth = 4;

  /// Copies kPanel rows as steps of the depth, starting at `k`.
  static VLA_INLINE void put_values(const Number* rows, std::int64_t k, std::int64_t, Number* panel) {
    for (int i = 0; i < kPanel; ++i)
      std::memcpy(panel + (k + i) * kPanel, rows + i * kHeadStride, kPanel * sizeof(*rows));
  }

  /// Products that are computed immediately.
  struct Work {
    /// c = a * panel, or c += a * panel if `sum`. a [depth, kTile] and c [width, kTile], with row strides `kStrideA`
    /// and `kStrideC`.
    template <int kStrideA, int kStrideC>
    VLA_INLINE void add(const float* a, const float* panel, std::int64_t depth, std::int64_t, float* c, bool sum) {
      Float sums[kVectors][kTile];
      const Float zero = {};
#pragma GCC unroll 4
      for (auto& column : sums)
#pragma GCC unroll 6
        for (Float& one : column) one = zero;
      for (const float* end = a + depth; a < end; a += kDepth, panel += kDepth * kPanel) {
        Float rows[kTile];
#pragma GCC unroll 6
        for (int r = 0; r < kTile; ++r) rows[r] = Neon::load(a + r * kStrideA);
#pragma GCC unroll 4
        for (int n = 0; n < kVectors; ++n) multiply_add_floats<0>(panel + 4 * n, rows, zero, sums[n]);
#pragma GCC unroll 4
        for (int n = 0; n < kVectors; ++n) multiply_add_floats<1>(panel + kPanel + 4 * n, rows, zero, sums[n]);
#pragma GCC unroll 4
        for (int n = 0; n < kVectors; ++n) multiply_add_floats<2>(panel + 2 * kPanel + 4 * n, rows, zero, sums[n]);
#pragma GCC unroll 4
        for (int n = 0; n < kVectors; ++n) multiply_add_floats<3>(panel + 3 * kPanel + 4 * n, rows, zero, sums[n]);
      }
#pragma GCC unroll 6
      for (int r = 0; r < kTile; ++r)
#pragma GCC unroll 4
        for (int n = 0; n < kVectors; ++n) {
          float* out = c + r * kStrideC + 4 * n;
          Neon::store(out, sum ? Neon::load(out) + sums[n][r] : sums[n][r]);
        }
    }
    int n_step() const { return 0; }
    void advance(int) const {}
    void finish() const {}
  };
};

}  // namespace vla::kernels

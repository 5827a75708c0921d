// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "kernels/vec.h"

/// The two arithmetics that attention multiplies in. Both products of attention have the same form: rows of numbers
/// times panels, which hold for each step of the depth one number of every column.
namespace vla::kernels {

/// Float32: kRowsOfTile rows times two vectors, one operand broadcast. `V` is a type of vec.h.
template <class V, int kRowsOfTile>
struct FloatProducts {
  using Vector = V;
  using Number = float;
  struct Session {};
  static constexpr int kTile = kRowsOfTile, kRows = 24;                            // rows of a tile, and of a block
  static constexpr int kPanel = 2 * V::width, kLeastPanel = V::width, kDepth = 1;  // columns; unit of the depth

  /// Where a panel of `width` columns holds number `k` of column `n`.
  static VLA_INLINE std::int64_t place(std::int64_t k, std::int64_t n, std::int64_t width) { return k * width + n; }
  static VLA_INLINE void store(float* to, typename V::Float x) { V::store(to, x); }

  /// c = a * panel, or c += where kAdd. a [depth, kTile] and c [width, kTile], rows `kStrideA` and `kStrideC` apart.
  template <int kStrideA, int kStrideC, bool kAdd>
  static VLA_INLINE void multiply(const float* a, const float* panel, std::int64_t depth, std::int64_t width,
                                  float* c) {
    if (width == kPanel)
      multiply_vectors<2, kStrideA, kStrideC, kAdd>(a, panel, depth, c);
    else
      multiply_vectors<1, kStrideA, kStrideC, kAdd>(a, panel, depth, c);
  }

 private:
  template <int kVectors, int kStrideA, int kStrideC, bool kAdd>
  static VLA_INLINE void multiply_vectors(const float* a, const float* panel, std::int64_t depth, float* c) {
    typename V::Float sums[kTile][kVectors] = {};
#pragma GCC unroll 4
    for (std::int64_t i = 0; i < depth; ++i) {
      typename V::Float column[kVectors];
      for (int n = 0; n < kVectors; ++n) column[n] = V::load(panel + (i * kVectors + n) * V::width);
#pragma GCC unroll 16
      for (int r = 0; r < kTile; ++r) {
        const typename V::Float row = V::set(a[r * kStrideA + i]);
        for (int n = 0; n < kVectors; ++n) sums[r][n] = V::fma(row, column[n], sums[r][n]);
      }
    }
    for (int r = 0; r < kTile; ++r)
      for (int n = 0; n < kVectors; ++n) {
        float* out = c + r * kStrideC + n * V::width;
        V::store(out, kAdd ? V::load(out) + sums[r][n] : sums[r][n]);
      }
  }
};

/// Numbers rounded to bf16, sums in float32: 32 rows times 32 columns, through a tile type that multiplies 16 x 16
/// words of two numbers each (AMX, or its emulation).
template <class V, class Tile>
struct PairProducts {
  using Vector = V;
  using Number = std::uint16_t;
  using Session = typename Tile::Session;
  static constexpr int kTile = 32, kRows = 32, kPanel = 32, kLeastPanel = 32, kDepth = 32;

  /// For each 32 of the depth two tiles of 16 columns; in each of their 16 lines a pair of every column.
  static VLA_INLINE std::int64_t place(std::int64_t k, std::int64_t n, std::int64_t) {
    return k / 32 * 1024 + n / 16 * 512 + k % 32 / 2 * 32 + n % 16 * 2 + k % 2;
  }

  /// One vector to the nearest bf16, ties to even, as PyTorch rounds; a NaN stays one.
  static VLA_INLINE void store(Number* to, typename V::Float x) {
    typedef std::uint16_t Half __attribute__((vector_size(2 * V::width)));
    const auto bits = std::bit_cast<typename V::Int>(x);
    const auto rounded = x == x ? (bits + 0x7fff + ((bits >> 16) & 1)) >> 16 : bits >> 16 | 64;
    const Half narrow = __builtin_convertvector(rounded, Half);
    std::memcpy(to, &narrow, sizeof(narrow));
  }

  template <int kStrideA, int kStrideC, bool kAdd>
  static VLA_INLINE void multiply(const Number* a, const Number* panel, std::int64_t depth, std::int64_t, float* c) {
    Tile::template multiply<kStrideA, kStrideC, kAdd>(a, panel, depth, c);
  }
};

}  // namespace vla::kernels

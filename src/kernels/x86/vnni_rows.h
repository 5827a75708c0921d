// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "kernels/int8_panels.h"
#include "kernels/tile_heights.h"
#include "kernels/x86/vec_avx512.h"

namespace vla::kernels {

/// Up to six rows by kStrips vectors, whose sums stay in registers. AVX-512 VNNI's vpdpbusd adds four u8 x s8 products
/// to int32.
template <int kStrips>
struct VnniRows {
  static constexpr int kRows = 6, kColumns = kStrips * static_cast<int>(Int8Panels::kColumns);

  /// The same as `multiply` of a tile of Int8Loop, without `between`.
  template <class Strips>
  static void multiply(int n_row, const std::byte* x, std::int64_t x_stride, const Strips& strips, std::int64_t depth,
                       std::int32_t* sums, bool add) {
    with_height<kRows>(n_row, [&]<int n>() { tile<n>(x, x_stride, strips, depth, sums, add); });
  }

 private:
  static VLA_INLINE void add_products(__m512i& sum, __m512i numbers, __m512i codes) {
#ifdef VLA_EMULATED_INSTRUCTIONS  // in plain C++ for tests
    sum = _mm512_dpbusd_epi32(sum, numbers, codes);
#else  // with the intrinsic, compilers copy every sum
    asm("vpdpbusd %2, %1, %0" : "+v"(sum) : "v"(numbers), "v"(codes));
#endif
  }

  template <int kCount, class Strips>
  static void tile(const std::byte* x, std::int64_t x_stride, const Strips& strips, std::int64_t depth,
                   std::int32_t* sums, bool add) {
    __m512i sum[kCount][kStrips];
#pragma GCC unroll 6
    for (int r = 0; r < kCount; ++r)
#pragma GCC unroll 4
      for (int j = 0; j < kStrips; ++j)
        sum[r][j] = add ? _mm512_loadu_si512(sums + r * kColumns + 16 * j) : _mm512_setzero_si512();
    for (std::int64_t k = 0; k < depth; k += kQuantizedUnit)
      for (int group = 0; group < kQuantizedUnit / 4; group += 4)
#pragma GCC unroll 4
        for (int s = group; s < group + 4; ++s, x += 4) {
          __m512i numbers[kStrips];
#pragma GCC unroll 4
          for (int j = 0; j < kStrips; ++j)
            numbers[j] = strips.template load<__m512i>(k, s, j, 0), strips.fetch(k, s, j);
#pragma GCC unroll 6
          for (int r = 0; r < kCount; ++r) {
            std::int32_t four;
            std::memcpy(&four, x + r * x_stride, sizeof(four));
            const __m512i codes = _mm512_set1_epi32(four);
#pragma GCC unroll 4
            for (int j = 0; j < kStrips; ++j) add_products(sum[r][j], numbers[j], codes);
          }
        }
#pragma GCC unroll 6
    for (int r = 0; r < kCount; ++r)
#pragma GCC unroll 4
      for (int j = 0; j < kStrips; ++j) _mm512_storeu_si512(sums + r * kColumns + 16 * j, sum[r][j]);
  }
};

}  // namespace vla::kernels

// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "kernels/linear_loop.h"
#include "kernels/tile_heights.h"
#include "kernels/x86/vec_avx512.h"

/// The inner loop of products on AVX-512: rows by 2 vectors of sums.
namespace vla::kernels {

constexpr int kAvx512Rows = 12;

/// `Step` describes a step: X and kCount (type and number of elements of x), kXStride (stride of rows of x), kBlock
/// (depth of a panel's block), kSize (bytes of a panel element), load(panel, i) (16 columns for step i from `panel`),
/// everywhere(x) (one step of x broadcast to all columns), and add(sum, value, weights).
template <class Step, int kCount>
void multiply_tile(const typename Step::X* x, const std::byte* panel, std::int64_t depth, float* c, bool add,
                   const Prefetch& ahead) {
  constexpr int kSteps = 4, kDepth = kSteps * Step::kCount;
  const std::int64_t n_line = ceil_div(ahead.size * kDepth, 64 * depth);  // cache lines to prefetch for each kDepth
  const std::byte* next = ahead.from;
  __m512 sum[kCount][2];
#pragma GCC unroll 12  // without it GCC keeps some of the sums in memory
  for (int r = 0; r < kCount; ++r) sum[r][0] = sum[r][1] = _mm512_setzero_ps();
  for (std::int64_t block = 0; block < depth; block += Step::kBlock, panel += 2 * kPanelBlock)
    for (int i = 0; i < Step::kBlock; i += kDepth, x += kDepth) {
      for (std::int64_t line = 0; line < n_line; ++line, next += 64) __builtin_prefetch(next, 0, 2);  // to L2
      const std::byte* numbers = panel + i * 16 * Step::kSize;
#pragma GCC unroll 4
      for (int k = 0; k < kSteps; ++k) {
        const auto left = Step::load(numbers, k), right = Step::load(numbers + kPanelBlock, k);
#pragma GCC unroll 12
        for (int r = 0; r < kCount; ++r) {
          auto value = Step::everywhere(x + k * Step::kCount + r * Step::kXStride);
          asm("" : "+v"(value));  // one load serves both products
          Step::add(sum[r][0], value, left);
          Step::add(sum[r][1], value, right);
        }
      }
    }
#pragma GCC unroll 12
  for (int r = 0; r < kCount; ++r)
    for (int i = 0; i < 2; ++i) {
      float* place = c + r * 32 + 16 * i;
      _mm512_storeu_ps(place, add ? _mm512_add_ps(sum[r][i], _mm512_loadu_ps(place)) : sum[r][i]);
    }
}

/// The same for any number of rows.
template <class Step>
void multiply_rows(int n_row, const typename Step::X* x, const std::byte* panel, std::int64_t depth, float* c, bool add,
                   const Prefetch& ahead) {
  with_height<kAvx512Rows>(n_row, [&]<int n>() { multiply_tile<Step, n>(x, panel, depth, c, add, ahead); });
}

}  // namespace vla::kernels

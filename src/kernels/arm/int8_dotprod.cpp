// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/arm/vec_neon.h"
#include "kernels/int8_loop.h"

namespace vla::kernels {
namespace {

/// SDOT: four products of codes and elements for each of four columns. A tile is 6 rows by 4 vectors. One load reads
/// sixteen codes of a row; an instruction selects four of them by lane.
struct DotTile {
  using V = Neon;
  static constexpr int kRows = 6, kColumns = 16, kBlockRows = 216, kStep = 512, kVectors = kColumns / V::width;
  static constexpr std::int64_t kBlockKiB = 256;
  static constexpr bool kEven = true, kBeside = false, kSigned = false;
  static constexpr RoundedLayout kLayout = RoundedLayout::none;
  struct Session {};

  template <class Strips, class Between>
  static void multiply(int n_row, const std::byte* x, std::int64_t x_stride, const Strips& strips, std::int64_t depth,
                       std::int32_t* sums, bool add, const Between&) {
    with_height<kRows>(n_row, [&]<int n>() { tile<n>(x, x_stride, strips, depth, sums, add); });
  }

 private:
  template <int kCount, class Strips>
  static void tile(const std::byte* x, std::int64_t x_stride, const Strips& strips, std::int64_t depth,
                   std::int32_t* to, bool add) {
    int32x4_t sums[kVectors][kCount];
#pragma GCC unroll 4
    for (auto& column : sums)
#pragma GCC unroll 6
      for (int32x4_t& sum : column) sum = vdupq_n_s32(0);
    for (std::int64_t k = 0; k < depth; k += Int8Panels::kGroup, x += Int8Panels::kGroup) {
      int8x16_t rows[kCount];
#pragma GCC unroll 6
      for (int r = 0; r < kCount; ++r) std::memcpy(&rows[r], x + r * x_stride, sizeof(rows[r]));
      step<0>(strips, k, rows, sums);
      step<1>(strips, k, rows, sums);
      step<2>(strips, k, rows, sums);
      step<3>(strips, k, rows, sums);
    }
#pragma GCC unroll 6
    for (int r = 0; r < kCount; ++r)
#pragma GCC unroll 4
      for (int n = 0; n < kVectors; ++n) {
        std::int32_t* place = to + r * kColumns + V::width * n;
        vst1q_s32(place, add ? vaddq_s32(sums[n][r], vld1q_s32(place)) : sums[n][r]);
      }
  }

  template <int s, class Strips, int kCount>
  static VLA_INLINE void step(const Strips& strips, std::int64_t k, const int8x16_t (&rows)[kCount],
                              int32x4_t (&sums)[kVectors][kCount]) {
#pragma GCC unroll 4
    for (int n = 0; n < kVectors; ++n) multiply_add<s>(strips.template load<int8x16_t>(k, s, 0, 16 * n), rows, sums[n]);
  }

  /// sums += weights * four codes of each row. Written as assembly for the reason given in neon_multiply_add.h.
  template <int s, int kCount>
  static VLA_INLINE void multiply_add(int8x16_t numbers, const int8x16_t (&rows)[kCount], int32x4_t (&sums)[kCount]) {
    if constexpr (kCount == 6)
      asm("sdot %0.4s, %6.16b, %7.4b[%13]\n\tsdot %1.4s, %6.16b, %8.4b[%13]\n\tsdot %2.4s, %6.16b, %9.4b[%13]\n\t"
          "sdot %3.4s, %6.16b, %10.4b[%13]\n\tsdot %4.4s, %6.16b, %11.4b[%13]\n\tsdot %5.4s, %6.16b, %12.4b[%13]"
          : "+w"(sums[0]), "+w"(sums[1]), "+w"(sums[2]), "+w"(sums[3]), "+w"(sums[4]), "+w"(sums[5])
          : "w"(numbers), "w"(rows[0]), "w"(rows[1]), "w"(rows[2]), "w"(rows[3]), "w"(rows[4]), "w"(rows[5]), "n"(s));
    else
#pragma GCC unroll 6
      for (int r = 0; r < kCount; ++r) sums[r] = vdotq_laneq_s32(sums[r], numbers, rows[r], s);
  }
};

bool supports(const MatrixDesc& desc, Features use) { return !is_float(desc.type) && use.has(Feature::dotprod); }

}  // namespace

extern const LinearKernel kTernaryDotprod, kInt4Dotprod, kInt8Dotprod;
const LinearKernel kTernaryDotprod = Int8Loop<DotTile, TernaryPanels>::kernel("dotprod_int8", supports);
const LinearKernel kInt4Dotprod = Int8Loop<DotTile, Int4Panels>::kernel("dotprod_int8", supports);
const LinearKernel kInt8Dotprod = Int8Loop<DotTile, BytePanels>::kernel("dotprod_int8", supports);

}  // namespace vla::kernels

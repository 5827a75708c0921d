// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/arm/mmla.h"
#include "kernels/arm/vec_neon.h"
#include "kernels/int8_loop.h"

namespace vla::kernels {
namespace {

struct Int8Pairs {
  using Sum = std::int32_t;
  using Vector = int32x4_t;
  static VLA_INLINE Vector multiply(Vector sums, int8x16_t rows, int8x16_t columns) {
    return vmmlaq_s32(sums, rows, columns);
  }
  static VLA_INLINE void three_pairs(const std::byte* a0, const std::byte* a1, const std::byte* a2,
                                     const std::byte* panel, std::int64_t n_step, const std::byte* ahead,
                                     std::int64_t skip, Vector* sums) {
    VLA_MMLA_LOOP("smmla", "16b", "");
  }
};

/// SMMLA: 6 rows by 16 columns, as 24 sums of two rows by two columns.
struct MatrixTile {
  using V = Neon;
  static constexpr int kRows = kMmlaRows, kColumns = kMmlaColumns, kBlockRows = 216, kStep = 2048;
  static constexpr std::int64_t kBlockKiB = 256;
  static constexpr bool kEven = false, kBeside = false, kSigned = false, kPairs = true;
  static constexpr RoundedLayout kLayout = RoundedLayout::none;
  struct Session {};

  /// Interleaves two rows of codes.
  static VLA_INLINE void pair(const std::byte* first, const std::byte* second, std::int64_t depth, std::byte* to) {
    for (std::int64_t k = 0; k < depth; k += 16, to += 32) {
      int64x2_t a, b;
      std::memcpy(&a, first + k, sizeof(a)), std::memcpy(&b, second + k, sizeof(b));
      const int64x2_t low = vzip1q_s64(a, b), high = vzip2q_s64(a, b);
      std::memcpy(to, &low, sizeof(low)), std::memcpy(to + 16, &high, sizeof(high));
    }
  }

  /// Rearranges lines of four elements per column into pairs of columns with eight elements.
  template <class Strips>
  static VLA_INLINE void expand(const Strips& strips, std::int64_t depth, std::byte* to) {
    for (std::int64_t k = 0; k < depth; k += Int8Panels::kGroup, to += 256)
#pragma GCC unroll 4
      for (int n = 0; n < 4; ++n)
#pragma GCC unroll 2
        for (int s = 0; s < 4; s += 2) {
          const auto a = strips.template load<int32x4_t>(k, s, 0, 16 * n);
          const auto b = strips.template load<int32x4_t>(k, s + 1, 0, 16 * n);
          const int32x4_t low = vzip1q_s32(a, b), high = vzip2q_s32(a, b);
          std::memcpy(to + 64 * s + 32 * n, &low, sizeof(low));
          std::memcpy(to + 64 * s + 32 * n + 16, &high, sizeof(high));
        }
  }

  static void multiply(int n_row, const std::byte* x, std::int64_t x_stride, const std::byte* panel, std::int64_t depth,
                       std::int32_t* sums, bool add) {
    multiply_mmla<Int8Pairs>(n_row, x, 2 * x_stride, panel, depth / kMmlaStep, sums, add, {panel, 0});
  }
};

bool supports(const MatrixDesc& desc, Features use) {
  return !is_float(desc.type) && use.has(Feature::i8mm) && use.has(Feature::dotprod) && desc.d_in <= kMaxPairedDepth;
}

/// For few rows, rearranging pairs costs more than it gains; SDOT reads codes as they are.
template <class Panels>
constexpr LinearKernel kernel(const LinearKernel& small_batch) {
  LinearKernel row = Int8Loop<MatrixTile, Panels>::kernel("i8mm_int8", supports);
  row.small_batch = &small_batch, row.max_small_batch = 32;
  return row;
}

}  // namespace

extern const LinearKernel kTernaryDotprod, kInt4Dotprod, kInt8Dotprod;
extern const LinearKernel kTernaryI8mm, kInt4I8mm, kInt8I8mm;
const LinearKernel kTernaryI8mm = kernel<TernaryPanels>(kTernaryDotprod);
const LinearKernel kInt4I8mm = kernel<Int4Panels>(kInt4Dotprod);
const LinearKernel kInt8I8mm = kernel<BytePanels>(kInt8Dotprod);

}  // namespace vla::kernels

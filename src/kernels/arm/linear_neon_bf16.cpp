// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/arm/mmla.h"
#include "kernels/arm/vec_neon.h"
#include "kernels/linear_loop.h"
#include "kernels/tile_heights.h"

namespace vla::kernels {
namespace {

/// BFMMLA adds four products of bf16 to a sum, two at a time. Each time it rounds the sum of the two products, and then
/// that plus the accumulator, to odd: to the neighbour with an odd last bit, an error below one unit in the last place
/// instead of IEEE's half. Values below 2^-126 are flushed to zero. Source: Arm Architecture Reference Manual,
/// BFMatMulAddH and BFRound with FPCR.EBF = 0, which is Linux's setting.
struct Bf16Pairs {
  using Sum = float;
  using Vector = float32x4_t;
  static VLA_INLINE Vector multiply(Vector sums, int8x16_t rows, int8x16_t columns) {
    return vbfmmlaq_f32(sums, std::bit_cast<bfloat16x8_t>(rows), std::bit_cast<bfloat16x8_t>(columns));
  }
  static VLA_INLINE void three_pairs(const std::byte* a0, const std::byte* a1, const std::byte* a2,
                                     const std::byte* panel, std::int64_t n_step, const std::byte* ahead,
                                     std::int64_t skip, Vector* sums) {
    VLA_MMLA_LOOP("bfmmla", "8h", "prfm pldl2keep, [%[ahead]]\n\tadd %[ahead], %[ahead], %[skip]\n\t");
  }
};

/// 6 rows by 16 columns, as 24 sums of two rows by two columns.
struct NeonBf16Tile {
  using V = Neon;
  using X = std::uint16_t;
  static constexpr int kRows = kMmlaRows, kColumns = kMmlaColumns;
  static constexpr int kMaxDepth = 2048, kStep = 1024, kBlockRows = 108;
  static constexpr int kXStride = kMaxDepth + 16;
  static constexpr bool kEven = false, kRounds = true;  // a tile starts at the first row of a pair

  static VLA_INLINE std::int64_t place(std::int64_t r, std::int64_t k) {
    return r / 2 * 2 * kXStride + r % 2 * kQuad + 2 * k;
  }

  static VLA_INLINE void store_rounded(X* to, V::Float x, std::int64_t left) {
    const bfloat16x4_t numbers = vcvt_bf16_f32(x);
    std::memcpy(to, &numbers, left >= V::width ? sizeof(numbers) : static_cast<std::size_t>(left) * sizeof(*to));
  }

  // Writes n elements of a row, padded with zeros to a multiple of 32.
  static VLA_INLINE void copy(const float* from, std::int64_t n, X* to) {
    for (std::int64_t k = 0; k < round_up(n, kPanelDepth); k += kQuad, to += 2 * kQuad)
      store_rounded(to, k < n ? load<V>(from + k, n - k) : V::Float{}, kQuad);
  }
  static VLA_INLINE void copy(const X* from, std::int64_t n, X* to) {
    for (std::int64_t k = 0; k < round_up(n, kPanelDepth); k += kQuad, to += 2 * kQuad) {
      std::memset(to, 0, kQuad * sizeof(*to));
      if (k < n) std::memcpy(to, from + k, static_cast<std::size_t>(min(kQuad, n - k)) * sizeof(*to));
    }
  }

  static void multiply(DType, int n_row, const X* x, const std::byte* panel, std::int64_t depth, float* c, bool add,
                       const Prefetch& ahead) {
    const std::int64_t n_step = depth / kQuad;
    multiply_mmla<Bf16Pairs>(n_row, reinterpret_cast<const std::byte*>(x), 2 * kXStride * std::int64_t{sizeof(X)},
                             panel, n_step, c, add, {ahead.from, ahead.size / n_step});
  }

  /// Panels of quads: four elements of each column in turn.
  static void pack(const MatrixDesc& desc, const std::byte* stored, std::byte* packed) {
    constexpr std::int64_t kSize = sizeof(X);
    const std::int64_t panel = Panels<kColumns>::size(DType::bf16, round_up(desc.d_in, kPanelDepth));
    std::memset(packed, 0, Panels<kColumns>::packed_size(desc));
    for (std::int64_t n = 0; n < desc.d_out; ++n, stored += desc.d_in * kSize) {
      std::byte* to = packed + n / kColumns * panel + n % kColumns * kMmlaStep;
      for (std::int64_t k = 0; k < desc.d_in; k += kQuad, to += kColumns * kMmlaStep)
        std::memcpy(to, stored + k * kSize, static_cast<std::size_t>(min(kQuad, desc.d_in - k) * kSize));
    }
  }

 private:
  static constexpr std::int64_t kQuad = kMmlaStep / std::int64_t{sizeof(X)};
};

/// For few rows, where reading weights is the bottleneck; x stays float32. 4 rows by 4 vectors, four steps of the depth
/// at a time.
struct QuadTile {
  using V = Neon;
  using X = float;
  static constexpr int kRows = 4, kColumns = kMmlaColumns, kVectors = kColumns / V::width;
  static constexpr int kMaxDepth = NeonBf16Tile::kMaxDepth, kStep = 1024, kBlockRows = 16;
  static constexpr int kXStride = kMaxDepth + 16;
  static constexpr bool kEven = true, kRounds = false;

  static VLA_INLINE void copy(const float* from, std::int64_t n, float* to) { copy_padded(from, n, to); }

  static void multiply(DType, int n_row, const float* x, const std::byte* panel, std::int64_t depth, float* c, bool add,
                       const Prefetch& ahead) {
    with_height<kRows>(n_row, [&]<int n>() { tile<n>(x, panel, depth, c, add, ahead.from); });
  }

 private:
  template <int kCount>
  static void tile(const float* x, const std::byte* panel, std::int64_t depth, float* c, bool add,
                   const std::byte* ahead) {
    V::Float sums[kVectors][kCount] = {};
    for (const float* end = x + depth; x < end; x += 4, panel += 128, ahead += 32) {
      __builtin_prefetch(ahead, 0, 2);
      V::Float rows[kCount];
#pragma GCC unroll 4
      for (int r = 0; r < kCount; ++r) rows[r] = V::load(x + r * kXStride);
#pragma GCC unroll 4
      for (int n = 0; n < kVectors; ++n) {
        V::Int quads[2];  // two columns each
        std::memcpy(quads, panel + 32 * n, sizeof(quads));
        const V::Int first = vuzp1q_s32(quads[0], quads[1]), second = vuzp2q_s32(quads[0], quads[1]);
        multiply_add<0>(first << 16, rows, sums[n]);
        multiply_add<1>(first & ~0xffff, rows, sums[n]);
        multiply_add<2>(second << 16, rows, sums[n]);
        multiply_add<3>(second & ~0xffff, rows, sums[n]);
      }
    }
#pragma GCC unroll 4
    for (int r = 0; r < kCount; ++r)
#pragma GCC unroll 4
      for (int n = 0; n < kVectors; ++n) {
        float* place = c + r * kColumns + V::width * n;
        V::store(place, add ? sums[n][r] + V::load(place) : sums[n][r]);
      }
  }

  /// Written as assembly for the reason given in neon_multiply_add.h.
  template <int k, int kCount>
  static VLA_INLINE void multiply_add(V::Int numbers, const V::Float (&rows)[kCount], V::Float (&sums)[kCount]) {
    if constexpr (kCount == kRows)
      asm("fmla %0.4s, %4.4s, %5.s[%9]\n\tfmla %1.4s, %4.4s, %6.s[%9]\n\t"
          "fmla %2.4s, %4.4s, %7.s[%9]\n\tfmla %3.4s, %4.4s, %8.s[%9]"
          : "+w"(sums[0]), "+w"(sums[1]), "+w"(sums[2]), "+w"(sums[3])
          : "w"(numbers), "w"(rows[0]), "w"(rows[1]), "w"(rows[2]), "w"(rows[3]), "n"(k));
    else
#pragma GCC unroll 4
      for (int r = 0; r < kCount; ++r) sums[r] = vfmaq_laneq_f32(sums[r], std::bit_cast<V::Float>(numbers), rows[r], k);
  }
};

constexpr std::int64_t kMaxFew = 16;

bool supports(const MatrixDesc& desc, Features use) { return use.has(Feature::neon_bf16) && desc.type == DType::bf16; }

constexpr LinearKernel of_quads(LinearKernel kernel) {
  kernel.pack = NeonBf16Tile::pack;
  return kernel;
}

constexpr LinearKernel kFew = of_quads(LinearLoop<QuadTile>::kernel("neon", supports));

}  // namespace

extern const LinearKernel kLinearNeonBf16;
const LinearKernel kLinearNeonBf16 = of_quads(LinearLoop<NeonBf16Tile>::kernel("neon_bf16", supports, &kFew, kMaxFew));

}  // namespace vla::kernels

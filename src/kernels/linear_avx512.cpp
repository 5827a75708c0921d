// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#if defined(__x86_64__)
#include "kernels/linear_loop.h"

namespace vla::kernels {
namespace {

/// 12 rows by 2 vectors: 24 sums. A step of a panel becomes [32, depth] floats first, once for all rows: widening in
/// the inner loop would take its turns from the multiply-adds.
struct Avx512Tile {
  using V = Avx512;
  using X = float;
  static constexpr int kRows = 12, kColumns = 32;
  static constexpr int kMaxDepth = 2048, kManyDepth = 1024, kStep = 384, kBlockRows = 144, kFineRows = 0,
                       kUnpacked = kStep * kColumns;
  static constexpr int kXStride = kMaxDepth + 16;  // not a multiple of a page, so that rows do not share cache lines
  static constexpr bool kEven = true, kRounds = false;
  struct Session {};

  static VLA_INLINE void copy(const float* from, std::int64_t n, float* to, float*) { copy_padded(from, n, to); }

  static const std::byte* unpack(DType type, const std::byte* panel, std::int64_t depth, float* floats) {
    // A block is as deep as it has lines of numbers; the two halves of a panel alternate.
    const std::int64_t block_depth = type == DType::f32 ? 16 : 32;
    for (std::int64_t k = 0; k < depth; k += block_depth)
      for (int half = 0; half < kColumns; half += 16, panel += kPanelBlock) {
        float* to = floats + k * kColumns + half;
        if (type == DType::bf16)
          widen_pairs(panel, to);
        else if (type == DType::f16)
          widen_halves(panel, to);
        else
          for (int i = 0; i < 16; ++i) _mm512_store_si512(to + i * kColumns, _mm512_loadu_si512(panel + 64 * i));
      }
    return reinterpret_cast<const std::byte*>(floats);
  }

  static void multiply(DType, int n_row, const float* x, const float*, const std::byte* panel, std::int64_t depth,
                       float* c, bool add, const std::byte* ahead) {
    using Function = void (*)(const float*, const float*, std::int64_t, float*, bool, const std::byte*);
    static constexpr Function kTiles[] = {tile<1>, tile<2>, tile<3>, tile<4>,  tile<5>,  tile<6>,
                                          tile<7>, tile<8>, tile<9>, tile<10>, tile<11>, tile<12>};
    kTiles[n_row - 1](x, reinterpret_cast<const float*>(panel), depth, c, add, ahead);
  }

 private:
  // With masks of ones where an instruction without one would do: GCC 12 warns of undefined lanes in its own header.
  static VLA_INLINE void widen_pairs(const std::byte* block, float* to) {
    const __m512i upper = _mm512_set1_epi32(static_cast<int>(0xffff0000U));
    for (int i = 0; i < 16; ++i, to += 2 * kColumns) {
      const __m512i words = _mm512_loadu_si512(block + 64 * i);
      _mm512_store_si512(to, _mm512_maskz_slli_epi32(0xffff, words, 16));
      _mm512_store_si512(to + kColumns, _mm512_and_si512(words, upper));
    }
  }
  static VLA_INLINE void widen_halves(const std::byte* block, float* to) {
    for (int i = 0; i < 32; ++i, to += kColumns) {
      const __m256i halves = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(block + 32 * i));
      _mm512_storeu_ps(to, _mm512_maskz_cvtph_ps(0xffff, halves));
    }
  }

  template <int kCount>
  static void tile(const float* x, const float* panel, std::int64_t depth, float* c, bool add, const std::byte* ahead) {
    __m512 sum[kCount][2];
    for (int r = 0; r < kCount; ++r) sum[r][0] = sum[r][1] = _mm512_setzero_ps();
    for (std::int64_t i = 0; i < depth; i += 4, panel += 4 * kColumns, x += 4, ahead += 64) {
      __builtin_prefetch(ahead, 0, 2);  // to the second cache
#pragma GCC unroll 2
      for (int k = 0; k < 4; ++k) {
        const __m512 left = _mm512_load_ps(panel + k * kColumns), right = _mm512_load_ps(panel + k * kColumns + 16);
#pragma GCC unroll 12
        for (int r = 0; r < kCount; ++r) {
          __m512 value = _mm512_set1_ps(x[k + r * kXStride]);
          asm("" : "+v"(value));  // one load for both products
          sum[r][0] = _mm512_fmadd_ps(value, left, sum[r][0]);
          sum[r][1] = _mm512_fmadd_ps(value, right, sum[r][1]);
        }
      }
    }
#pragma GCC unroll 12
    for (int r = 0; r < kCount; ++r)
      for (int i = 0; i < 2; ++i) {
        float* place = c + r * kColumns + 16 * i;
        _mm512_storeu_ps(place, add ? _mm512_add_ps(sum[r][i], _mm512_loadu_ps(place)) : sum[r][i]);
      }
  }
};

bool supports(const MatrixDesc& desc, Isa isa) { return isa >= Isa::avx512 && desc.type != DType::i32; }

}  // namespace

extern const LinearKernel kLinearAvx512;
const LinearKernel kLinearAvx512 = LinearLoop<Avx512Tile>::kernel("avx512", supports);

}  // namespace vla::kernels
#endif

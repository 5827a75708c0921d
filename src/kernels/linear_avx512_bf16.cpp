// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#if defined(__x86_64__)
#include "kernels/linear_pairs.h"
#include "kernels/rounding_avx512.h"

#define VLA_TILES \
  tile<1>, tile<2>, tile<3>, tile<4>, tile<5>, tile<6>, tile<7>, tile<8>, tile<9>, tile<10>, tile<11>, tile<12>

namespace vla::kernels {
namespace {

/// 12 rows by 2 vectors: 24 sums. One instruction multiplies a pair of x by the pairs of 16 columns, as the panel has
/// them.
struct Avx512Bf16Tile {
  using V = Avx512;
  using X = std::uint16_t;
  static constexpr int kRows = 12, kColumns = 32;
  static constexpr int kMaxDepth = 2048, kManyDepth = 1536, kStep = 384, kBlockRows = 192, kSplitRows = 0;
  static constexpr int kXStride = kMaxDepth + 32;
  static constexpr bool kEven = true, kRounds = true;
  struct Session {};

  static VLA_INLINE void store_rounded(X* to, V::Float x, std::int64_t left) { store_bf16(to, x, left); }

  static VLA_INLINE void copy(const float* from, std::int64_t n, X* to, X*) {
    for (std::int64_t i = 0; i < n; i += 32)
      store_bf16(to + i, load<V>(from + i, n - i), n - i > 16 ? load<V>(from + i + 16, n - i - 16) : V::Float{});
  }

  static void multiply(DType, int n_row, const X* x, const X*, const std::byte* panel, std::int64_t depth, float* c,
                       bool add, const Ahead& ahead) {
    using Function = void (*)(const X*, const std::byte*, std::int64_t, float*, bool, const Ahead&);
    static constexpr Function kTiles[] = {VLA_TILES};
    kTiles[n_row - 1](x, panel, depth, c, add, ahead);
  }

 private:
  static VLA_INLINE __m512bh pairs(const void* p) {
    __m512bh x;
    std::memcpy(&x, p, sizeof(x));
    return x;
  }
  /// A pair of x for every column.
  static VLA_INLINE __m512i everywhere(const X* x) {
    std::int32_t pair;
    std::memcpy(&pair, x, sizeof(pair));
    return _mm512_set1_epi32(pair);
  }

  template <int kCount>
  static void tile(const X* x, const std::byte* panel, std::int64_t depth, float* c, bool add, const Ahead& ahead) {
    const std::int64_t n_line = ceil_div(ahead.size, 8 * depth);  // of the cache, for each 8 of the depth
    const std::byte* next = ahead.from;
    __m512 sum[kCount][2];
    for (int r = 0; r < kCount; ++r) sum[r][0] = sum[r][1] = _mm512_setzero_ps();
    for (std::int64_t block = 0; block < depth; block += kPanelDepth, panel += 2 * kPanelBlock)
      for (int i = 0; i < kPanelDepth; i += 8, x += 8) {
        for (std::int64_t line = 0; line < n_line; ++line, next += 64) __builtin_prefetch(next, 0, 2);  // to L2
#pragma GCC unroll 4
        for (int k = 0; k < 8; k += 2) {
          const __m512bh left = pairs(panel + 32 * (i + k)), right = pairs(panel + kPanelBlock + 32 * (i + k));
#pragma GCC unroll 12
          for (int r = 0; r < kCount; ++r) {
            __m512i pair = everywhere(x + k + r * kXStride);
            asm("" : "+v"(pair));  // one load for both products
            sum[r][0] = _mm512_dpbf16_ps(sum[r][0], left, std::bit_cast<__m512bh>(pair));
            sum[r][1] = _mm512_dpbf16_ps(sum[r][1], right, std::bit_cast<__m512bh>(pair));
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

/// Few rows are bound by reading weights: x stays as it is there.
constexpr std::int64_t kMaxFew = 16;

bool supports(const MatrixDesc& desc, Isa isa) { return isa >= Isa::avx512_bf16 && desc.type == DType::bf16; }

}  // namespace

extern const LinearKernel kLinearAvx512, kLinearAvx512Bf16;
const LinearKernel kLinearAvx512Bf16 =
    LinearLoop<Avx512Bf16Tile>::kernel("avx512_bf16", supports, &kLinearAvx512, kMaxFew);

}  // namespace vla::kernels
#endif

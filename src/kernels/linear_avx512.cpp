// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#if defined(__x86_64__)
#include "kernels/linear_loop.h"

#define VLA_TILES(Source)                                                                               \
  tile<1, Source>, tile<2, Source>, tile<3, Source>, tile<4, Source>, tile<5, Source>, tile<6, Source>, \
      tile<7, Source>, tile<8, Source>, tile<9, Source>, tile<10, Source>, tile<11, Source>, tile<12, Source>

namespace vla::kernels {
namespace {

/// 12 rows by 2 vectors: 24 sums. Numbers of a panel are widened as they are loaded, so that a step of it takes half of
/// the first cache and leaves the rest to x.
struct Avx512Tile {
  using V = Avx512;
  using X = float;
  static constexpr int kRows = 12, kColumns = 32;
  static constexpr int kMaxDepth = 2048, kManyDepth = 1024, kStep = 256, kBlockRows = 144, kSplitRows = 0;
  static constexpr int kXStride = kMaxDepth + 16;  // not a multiple of a page, so that rows do not share cache lines
  static constexpr bool kEven = true, kRounds = false;
  struct Session {};

  static VLA_INLINE void copy(const float* from, std::int64_t n, float* to, float*) { copy_padded(from, n, to); }

  static void multiply(DType type, int n_row, const float* x, const float*, const std::byte* panel, std::int64_t depth,
                       float* c, bool add, const Ahead& ahead) {
    using Function = void (*)(const float*, const std::byte*, std::int64_t, float*, bool, const Ahead&);
    static constexpr Function kPairs[] = {VLA_TILES(Pairs)}, kHalves[] = {VLA_TILES(Halves)},
                              kFloats[] = {VLA_TILES(Floats)};
    const Function* tiles = type == DType::bf16 ? kPairs : type == DType::f16 ? kHalves : kFloats;
    tiles[n_row - 1](x, panel, depth, c, add, ahead);
  }

 private:
  // Number k of 16 columns, as floats: the blocks of a panel's two halves alternate, and each is kBlock deep. With
  // masks of ones where an instruction without one would do: GCC 12 warns of undefined lanes in its own header.
  struct Pairs {
    static constexpr int kBlock = 32, kSize = 2;
    static VLA_INLINE __m512 load(const std::byte* p, int k) {
      const __m512i words = _mm512_loadu_si512(p + 64 * (k / 2));
      return std::bit_cast<__m512>(k % 2 == 0 ? _mm512_maskz_slli_epi32(0xffff, words, 16)
                                              : _mm512_and_si512(words, _mm512_set1_epi32(-0x10000)));
    }
  };
  struct Halves {
    static constexpr int kBlock = 32, kSize = 2;
    static VLA_INLINE __m512 load(const std::byte* p, int k) {
      return _mm512_maskz_cvtph_ps(0xffff, _mm256_loadu_si256(reinterpret_cast<const __m256i*>(p + 32 * k)));
    }
  };
  struct Floats {
    static constexpr int kBlock = 16, kSize = 4;
    static VLA_INLINE __m512 load(const std::byte* p, int k) { return _mm512_loadu_ps(p + 64 * k); }
  };

  template <int kCount, class Source>
  static void tile(const float* x, const std::byte* panel, std::int64_t depth, float* c, bool add, const Ahead& ahead) {
    const std::int64_t n_line = ceil_div(ahead.size, 16 * depth);  // of the cache, for each 4 of the depth
    const std::byte* next = ahead.from;
    __m512 sum[kCount][2];
    for (int r = 0; r < kCount; ++r) sum[r][0] = sum[r][1] = _mm512_setzero_ps();
    for (std::int64_t block = 0; block < depth; block += Source::kBlock, panel += 2 * kPanelBlock)
      for (int i = 0; i < Source::kBlock; i += 4, x += 4) {
        for (std::int64_t line = 0; line < n_line; ++line, next += 64) __builtin_prefetch(next, 0, 2);  // to L2
        const std::byte* numbers = panel + i * 16 * Source::kSize;
#pragma GCC unroll 4
        for (int k = 0; k < 4; ++k) {
          const __m512 left = Source::load(numbers, k), right = Source::load(numbers + kPanelBlock, k);
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

bool supports(const MatrixDesc& desc, Isa isa) { return isa >= Isa::avx512 && is_float(desc.type); }

}  // namespace

extern const LinearKernel kLinearAvx512;
const LinearKernel kLinearAvx512 = LinearLoop<Avx512Tile>::kernel("avx512", supports);

}  // namespace vla::kernels
#endif

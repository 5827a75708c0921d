// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/linear_loop.h"
#include "kernels/tile_heights.h"
#include "kernels/x86/vec_avx2.h"

namespace vla::kernels {
namespace {

/// 6 rows by 2 vectors: twelve of the sixteen registers hold sums, enough to hide the latency of two multiply-adds per
/// cycle. Widening of stored elements overlaps with the multiply-adds.
struct Avx2Tile {
  using V = Avx2;
  using X = float;
  static constexpr int kRows = 6, kColumns = 16;
  static constexpr int kMaxDepth = 2048, kStep = 768, kBlockRows = 54;
  // not a multiple of a page, so that rows do not compete for the same cache lines
  static constexpr int kXStride = kMaxDepth + 16;
  static constexpr bool kEven = true, kRounds = false;

  static VLA_INLINE void copy(const float* from, std::int64_t n, float* to) { copy_padded(from, n, to); }

  static void multiply(DType type, int n_row, const float* x, const std::byte* panel, std::int64_t depth, float* c,
                       bool add, const Prefetch& ahead) {
    with_height<kRows>(n_row, [&]<int n>() {
      if (type == DType::bf16)
        tile<n, Pairs>(x, panel, depth, c, add, ahead.from);
      else if (type == DType::f16)
        tile<n, Halves>(x, panel, depth, c, add, ahead.from);
      else
        tile<n, Floats>(x, panel, depth, c, add, ahead.from);
    });
  }

 private:
  // Steps of the depth per cache line of a panel, and 8 columns of one step as floats.
  struct Pairs {
    static constexpr int kDepth = 2, kSize = 64;
    static VLA_INLINE __m256 load(const std::byte* line, int k, int half) {
      const __m256i words = _mm256_load_si256(reinterpret_cast<const __m256i*>(line) + half);
      return _mm256_castsi256_ps(k == 0 ? _mm256_slli_epi32(words, 16)
                                        : _mm256_and_si256(words, _mm256_set1_epi32(static_cast<int>(0xffff0000U))));
    }
  };
  struct Halves {
    static constexpr int kDepth = 1, kSize = 32;
    static VLA_INLINE __m256 load(const std::byte* line, int, int half) {
      return _mm256_cvtph_ps(_mm_load_si128(reinterpret_cast<const __m128i*>(line) + half));
    }
  };
  struct Floats {
    static constexpr int kDepth = 1, kSize = 64;
    static VLA_INLINE __m256 load(const std::byte* line, int, int half) {
      return _mm256_load_ps(reinterpret_cast<const float*>(line) + 8 * half);
    }
  };

  template <int kCount, class Line>
  static void tile(const float* x, const std::byte* line, std::int64_t depth, float* c, bool add,
                   const std::byte* ahead) {
    __m256 left[kCount], right[kCount];  // sums
#pragma GCC unroll 6
    for (int r = 0; r < kCount; ++r) left[r] = right[r] = _mm256_setzero_ps();
    for (const float* end = x + depth; x < end; ahead += 128) {
      __builtin_prefetch(ahead, 0, 2);  // prefetch to L2
      __builtin_prefetch(ahead + 64, 0, 2);
      for (int i = 0; i < kPanelDepth; i += Line::kDepth, line += Line::kSize, x += Line::kDepth)
#pragma GCC unroll 2
        for (int k = 0; k < Line::kDepth; ++k) {
          asm("" : "+r"(line));  // a line of pairs is loaded twice: keeping it in registers would spill sums
          const __m256 a = Line::load(line, k, 0), b = Line::load(line, k, 1);
#pragma GCC unroll 6
          for (int r = 0; r < kCount; ++r) multiply_add(x[k + r * kXStride], a, b, left[r], right[r]);
        }
    }
#pragma GCC unroll 6
    for (int r = 0; r < kCount; ++r) {
      float* place = c + r * kColumns;
      _mm256_store_ps(place, add ? _mm256_add_ps(left[r], _mm256_load_ps(place)) : left[r]);
      _mm256_store_ps(place + 8, add ? _mm256_add_ps(right[r], _mm256_load_ps(place + 8)) : right[r]);
    }
  }

  /// left += x * a, right += x * b. Written as assembly, because GCC otherwise moves sums between registers or
  /// broadcasts early and runs out of registers.
  static VLA_INLINE void multiply_add(const float& x, __m256 a, __m256 b, __m256& left, __m256& right) {
    __m256 value;
    asm("vbroadcastss %3, %2\n\tvfmadd231ps %4, %2, %0\n\tvfmadd231ps %5, %2, %1"
        : "+x"(left), "+x"(right), "=&x"(value)
        : "m"(x), "x"(a), "x"(b));
  }
};

bool supports(const MatrixDesc& desc, Features use) { return use.has(Feature::avx2) && is_float(desc.type); }

}  // namespace

extern const LinearKernel kLinearAvx2;
const LinearKernel kLinearAvx2 = LinearLoop<Avx2Tile>::kernel("avx2", supports);

}  // namespace vla::kernels

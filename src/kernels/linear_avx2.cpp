// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#if defined(__x86_64__)
#include "kernels/linear_kernel.h"
#include "kernels/linear_loop.h"

namespace vla::kernels {
namespace {

/// 6 rows by 2 vectors: twelve of the sixteen registers are sums, enough to hide the latency of two multiply-adds a
/// cycle. Panels of bf16 hold pairs, [16, depth / 2] words of two consecutive numbers, as the transposition of stored
/// rows leaves them; the shifts that widen them run beside the multiply-adds. Others are [16, depth] floats.
struct Avx2Tile {
  using V = Avx2;
  using X = float;
  static constexpr int kRows = 6, kColumns = 16, kDepth = 16;
  static constexpr int kMaxDepth = 768, kBlockRows = 60, kBlockColumns = 512;
  static constexpr int kXStride = kMaxDepth + 16;  // not a multiple of a page, so that rows do not share cache lines
  static constexpr int kPackCost = 3, kCopyCost = 1;
  static constexpr bool kPacked = false, kEven = true;
  struct Session {};

  static std::size_t panel_size(DType type, std::int64_t depth) {
    return static_cast<std::size_t>(depth) * kColumns * (type == DType::bf16 ? 2 : 4);
  }

  static VLA_INLINE void copy(const float* from, std::int64_t n, float* to) {
    std::memcpy(to, from, static_cast<std::size_t>(n) * sizeof(float));
    for (std::int64_t i = n; i % kDepth != 0; ++i) to[i] = 0;
  }

  static void pack(DType type, const std::byte* rows, std::int64_t d_in, std::int64_t n_column, std::int64_t depth,
                   std::byte* panel) {
    switch (type) {
      case DType::bf16:
        return pack_as<Pairs>(rows, d_in, n_column, depth, panel);
      case DType::f16:
        return pack_as<Halves>(rows, d_in, n_column, depth, panel);
      default:
        return pack_as<Floats>(rows, d_in, n_column, depth, panel);
    }
  }

  static void multiply(DType type, int n_row, const float* x, const std::byte* panel, std::int64_t depth, float* c,
                       std::int64_t stride, bool add) {
    using Function = void (*)(const float*, const std::byte*, std::int64_t, float*, std::int64_t, bool);
    static constexpr Function kPairs[] = {tile<1, true>, tile<2, true>, tile<3, true>,
                                          tile<4, true>, tile<5, true>, tile<6, true>};
    static constexpr Function kFloats[] = {tile<1, false>, tile<2, false>, tile<3, false>,
                                           tile<4, false>, tile<5, false>, tile<6, false>};
    (type == DType::bf16 ? kPairs : kFloats)[n_row - 1](x, panel, depth, c, stride, add);
  }

 private:
  // How eight words of a stored row are read; each holds `kStep / 8` numbers.
  struct Pairs {
    static constexpr int kStep = 16, kSize = 2;
    static VLA_INLINE __m256i load(const std::byte* p) {
      return _mm256_loadu_si256(reinterpret_cast<const __m256i*>(p));
    }
  };
  struct Halves {
    static constexpr int kStep = 8, kSize = 2;
    static VLA_INLINE __m256i load(const std::byte* p) {
      return _mm256_castps_si256(_mm256_cvtph_ps(_mm_loadu_si128(reinterpret_cast<const __m128i*>(p))));
    }
  };
  struct Floats {
    static constexpr int kStep = 8, kSize = 4;
    static VLA_INLINE __m256i load(const std::byte* p) { return Pairs::load(p); }
  };

  template <class Stored>
  static VLA_INLINE void pack_as(const std::byte* rows, std::int64_t d_in, std::int64_t n_column, std::int64_t depth,
                                 std::byte* panel) {
    constexpr int kStep = Stored::kStep;
    const std::int64_t stride = d_in * Stored::kSize;
    // Whole lines of the cache are read at a time: rows that are a page apart share places in it.
    const std::int64_t whole = n_column == kColumns ? depth / kDepth * kDepth : 0;
    for (std::int64_t k = 0; k < whole; k += kDepth)
      for (int half = 0; half < kColumns; half += 8)
        for (int i = 0; i < kDepth; i += kStep)
          transpose<Stored>(rows + half * stride + (k + i) * Stored::kSize, stride,
                            panel + line<Stored>(k + i) + half * 4);
    for (std::int64_t k = whole; k < depth; k += kStep) {
      alignas(32) std::byte corner[kColumns * 32] = {};
      const auto n = static_cast<std::size_t>(depth - k < kStep ? depth - k : kStep) * Stored::kSize;
      for (std::int64_t i = 0; i < n_column; ++i)
        std::memcpy(corner + i * 32, rows + i * stride + k * Stored::kSize, n);
      for (int half = 0; half < kColumns; half += 8)
        transpose<Stored>(corner + half * 32, 32, panel + line<Stored>(k) + half * 4);
    }
    for (std::int64_t k = (depth + kStep - 1) / kStep * kStep; k % kDepth != 0; k += kStep)
      std::memset(panel + line<Stored>(k), 0, 8 * kColumns * 4);
  }

  /// Where the words of depth k lie in a panel.
  template <class Stored>
  static VLA_INLINE std::int64_t line(std::int64_t k) {
    return k * 8 / Stored::kStep * kColumns * 4;
  }

  /// Eight words of eight rows, `stride` bytes apart, become eight lines of a panel.
  template <class Stored>
  static VLA_INLINE void transpose(const std::byte* rows, std::int64_t stride, std::byte* panel) {
    __m256i a[8], b[8];
    for (int i = 0; i < 8; ++i) a[i] = Stored::load(rows + i * stride);
    for (int i = 0; i < 8; i += 2) {
      b[i] = _mm256_unpacklo_epi32(a[i], a[i + 1]);
      b[i + 1] = _mm256_unpackhi_epi32(a[i], a[i + 1]);
    }
    for (int i = 0; i < 8; i += 4)
      for (int j = 0; j < 2; ++j) {
        a[i + 2 * j] = _mm256_unpacklo_epi64(b[i + j], b[i + j + 2]);
        a[i + 2 * j + 1] = _mm256_unpackhi_epi64(b[i + j], b[i + j + 2]);
      }
    auto* lines = reinterpret_cast<__m256i*>(panel);
    for (int i = 0; i < 4; ++i) {
      _mm256_store_si256(lines + 2 * i, _mm256_permute2x128_si256(a[i], a[i + 4], 0x20));
      _mm256_store_si256(lines + 2 * (i + 4), _mm256_permute2x128_si256(a[i], a[i + 4], 0x31));
    }
  }

  template <int kCount, bool kPairs>
  static void tile(const float* x, const std::byte* panel, std::int64_t depth, float* c, std::int64_t stride,
                   bool add) {
    __m256 left[kCount], right[kCount];  // sums
#pragma GCC unroll 6
    for (int r = 0; r < kCount; ++r) left[r] = right[r] = _mm256_setzero_ps();
    const auto step = [&](const float* column, __m256 a, __m256 b) __attribute__((always_inline)) {
#pragma GCC unroll 6
      for (int r = 0; r < kCount; ++r) {
        const __m256 value = _mm256_broadcast_ss(column + r * kXStride);
        left[r] = multiply_add(value, a, left[r]);
        right[r] = multiply_add(value, b, right[r]);
      }
    };
    if constexpr (kPairs) {
      const auto* word = reinterpret_cast<const __m256i*>(panel);
      const __m256i upper = _mm256_set1_epi32(static_cast<int>(0xffff0000U));
      for (std::int64_t k = 0; k < depth; k += 2, word += 2, x += 2) {
        step(x, _mm256_castsi256_ps(_mm256_slli_epi32(_mm256_load_si256(word), 16)),
             _mm256_castsi256_ps(_mm256_slli_epi32(_mm256_load_si256(word + 1), 16)));
        const __m256i* again = word;
        asm("" : "+r"(again));  // the words are read again: kept in registers, they would push sums out
        step(x + 1, _mm256_castsi256_ps(_mm256_and_si256(_mm256_load_si256(again), upper)),
             _mm256_castsi256_ps(_mm256_and_si256(_mm256_load_si256(again + 1), upper)));
      }
    } else {
      const auto* number = reinterpret_cast<const float*>(panel);
      for (std::int64_t k = 0; k < depth; ++k, number += kColumns, ++x)
        step(x, _mm256_load_ps(number), _mm256_load_ps(number + 8));
    }
#pragma GCC unroll 6
    for (int r = 0; r < kCount; ++r) {
      float* place = c + r * stride;
      _mm256_storeu_ps(place, add ? _mm256_add_ps(left[r], _mm256_loadu_ps(place)) : left[r]);
      _mm256_storeu_ps(place + 8, add ? _mm256_add_ps(right[r], _mm256_loadu_ps(place + 8)) : right[r]);
    }
  }

  /// a * b + sum. As an instruction, since GCC moves sums from register to register otherwise and runs out of them.
  static VLA_INLINE __m256 multiply_add(__m256 a, __m256 b, __m256 sum) {
    asm("vfmadd231ps %2, %1, %0" : "+x"(sum) : "x"(a), "x"(b));
    return sum;
  }
};

bool supports(const MatrixDesc& desc, Isa isa) { return isa >= Isa::avx2 && desc.type != DType::i32; }

}  // namespace

extern const LinearKernel kLinearAvx2;
const LinearKernel kLinearAvx2 = {
    {"avx2", nullptr, nullptr}, supports, LinearLoop<Avx2Tile>::run, LinearLoop<Avx2Tile>::kScratchSize};

}  // namespace vla::kernels
#endif

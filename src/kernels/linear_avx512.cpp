// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#if defined(__x86_64__)
#include "kernels/linear_kernel.h"
#include "kernels/linear_loop.h"

namespace vla::kernels {
namespace {

/// 12 rows by 2 vectors: 24 sums. Panels are [32, depth] floats whatever is stored, since widening in the inner loop
/// would take its turns from the multiply-adds.
struct Avx512Tile {
  using V = Avx512;
  using X = float;
  static constexpr int kRows = 12, kColumns = 32, kDepth = 32;
  static constexpr int kMaxDepth = 384, kBlockRows = 96, kBlockColumns = 512;
  static constexpr int kXStride = kMaxDepth + 16;  // not a multiple of a page, so that rows do not share cache lines
  static constexpr int kPackCost = 6, kCopyCost = 1;
  static constexpr bool kPacked = false, kEven = true;
  struct Session {};

  static std::size_t panel_size(DType, std::int64_t depth) {
    return static_cast<std::size_t>(depth) * kColumns * sizeof(float);
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

  static void multiply(DType, int n_row, const float* x, const std::byte* panel, std::int64_t depth, float* c,
                       std::int64_t stride, bool add) {
    using Function = void (*)(const float*, const float*, std::int64_t, float*, std::int64_t, bool);
    static constexpr Function kTiles[] = {tile<1>, tile<2>, tile<3>, tile<4>,  tile<5>,  tile<6>,
                                          tile<7>, tile<8>, tile<9>, tile<10>, tile<11>, tile<12>};
    kTiles[n_row - 1](x, reinterpret_cast<const float*>(panel), depth, c, stride, add);
  }

 private:
  // How sixteen words of a stored row are read; each holds `kStep / 16` numbers.
  struct Pairs {
    static constexpr int kStep = 32, kSize = 2;
    static VLA_INLINE __m512i load(const std::byte* p) { return _mm512_loadu_si512(p); }
  };
  struct Halves {
    static constexpr int kStep = 16, kSize = 2;
    static VLA_INLINE __m512i load(const std::byte* p) {
      const __m256i halves = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(p));
      return _mm512_castps_si512(_mm512_maskz_cvtph_ps(0xffff, halves));
    }
  };
  struct Floats {
    static constexpr int kStep = 16, kSize = 4;
    static VLA_INLINE __m512i load(const std::byte* p) { return _mm512_loadu_si512(p); }
  };

  template <class Stored>
  static VLA_INLINE void pack_as(const std::byte* rows, std::int64_t d_in, std::int64_t n_column, std::int64_t depth,
                                 std::byte* panel) {
    constexpr int kStep = Stored::kStep;
    auto* out = reinterpret_cast<float*>(panel);
    const std::int64_t stride = d_in * Stored::kSize;
    const std::int64_t whole = n_column == kColumns ? depth / kStep * kStep : 0;
    for (std::int64_t k = 0; k < whole; k += kStep)
      for (int half = 0; half < kColumns; half += 16)
        transpose<Stored>(rows + half * stride + k * Stored::kSize, stride, out + k * kColumns + half);
    for (std::int64_t k = whole; k < depth; k += kStep) {
      alignas(64) std::byte corner[kColumns * 64] = {};
      const auto n = static_cast<std::size_t>(depth - k < kStep ? depth - k : kStep) * Stored::kSize;
      for (std::int64_t i = 0; i < n_column; ++i)
        std::memcpy(corner + i * 64, rows + i * stride + k * Stored::kSize, n);
      for (int half = 0; half < kColumns; half += 16)
        transpose<Stored>(corner + half * 64, 64, out + k * kColumns + half);
    }
    for (std::int64_t k = (depth + kStep - 1) / kStep * kStep; k % kDepth != 0; k += kStep)
      std::memset(out + k * kColumns, 0, kStep * kColumns * sizeof(float));
  }

  // With masks of ones where an instruction without one would do: GCC 12 warns of undefined lanes in its own header.
  static VLA_INLINE __m512i low_words(__m512i a, __m512i b) { return _mm512_maskz_unpacklo_epi32(0xffff, a, b); }
  static VLA_INLINE __m512i high_words(__m512i a, __m512i b) { return _mm512_maskz_unpackhi_epi32(0xffff, a, b); }
  static VLA_INLINE __m512i low_pairs(__m512i a, __m512i b) { return _mm512_maskz_unpacklo_epi64(0xff, a, b); }
  static VLA_INLINE __m512i high_pairs(__m512i a, __m512i b) { return _mm512_maskz_unpackhi_epi64(0xff, a, b); }
  static VLA_INLINE __m512i even_lanes(__m512i a, __m512i b) { return _mm512_maskz_shuffle_i32x4(0xffff, a, b, 0x88); }
  static VLA_INLINE __m512i odd_lanes(__m512i a, __m512i b) { return _mm512_maskz_shuffle_i32x4(0xffff, a, b, 0xdd); }

  /// Sixteen words of sixteen rows, `stride` bytes apart, become sixteen half lines of a panel for each number in a
  /// word.
  template <class Stored>
  static VLA_INLINE void transpose(const std::byte* rows, std::int64_t stride, float* panel) {
    __m512i group[4][4];  // [i][j]: in lane l, word 4 l + j of rows 4 i to 4 i + 3
    for (int i = 0; i < 4; ++i) {
      __m512i row[4];
      for (int j = 0; j < 4; ++j) row[j] = Stored::load(rows + (4 * i + j) * stride);
      const __m512i a = low_words(row[0], row[1]), b = high_words(row[0], row[1]);
      const __m512i c = low_words(row[2], row[3]), d = high_words(row[2], row[3]);
      group[i][0] = low_pairs(a, c), group[i][1] = high_pairs(a, c);
      group[i][2] = low_pairs(b, d), group[i][3] = high_pairs(b, d);
    }
    for (int j = 0; j < 4; ++j) {
      const __m512i a = even_lanes(group[0][j], group[1][j]), b = odd_lanes(group[0][j], group[1][j]);
      const __m512i c = even_lanes(group[2][j], group[3][j]), d = odd_lanes(group[2][j], group[3][j]);
      put<Stored>(even_lanes(a, c), j, panel), put<Stored>(even_lanes(b, d), 4 + j, panel);
      put<Stored>(odd_lanes(a, c), 8 + j, panel), put<Stored>(odd_lanes(b, d), 12 + j, panel);
    }
  }

  /// Word i of sixteen rows.
  template <class Stored>
  static VLA_INLINE void put(__m512i words, int i, float* panel) {
    if constexpr (Stored::kStep == 16) {
      _mm512_store_si512(panel + i * kColumns, words);
    } else {
      _mm512_store_si512(panel + 2 * i * kColumns, _mm512_maskz_slli_epi32(0xffff, words, 16));
      const __m512i upper = _mm512_set1_epi32(static_cast<int>(0xffff0000U));
      _mm512_store_si512(panel + (2 * i + 1) * kColumns, _mm512_and_si512(words, upper));
    }
  }

  template <int kCount>
  static void tile(const float* x, const float* panel, std::int64_t depth, float* c, std::int64_t stride, bool add) {
    __m512 sum[kCount][2];
    for (int r = 0; r < kCount; ++r) sum[r][0] = sum[r][1] = _mm512_setzero_ps();
#pragma GCC unroll 2
    for (std::int64_t k = 0; k < depth; ++k, panel += kColumns, ++x) {
      const __m512 left = _mm512_load_ps(panel), right = _mm512_load_ps(panel + 16);
#pragma GCC unroll 12
      for (int r = 0; r < kCount; ++r) {
        __m512 value = _mm512_set1_ps(x[r * kXStride]);
        asm("" : "+v"(value));  // one load for both products
        sum[r][0] = _mm512_fmadd_ps(value, left, sum[r][0]);
        sum[r][1] = _mm512_fmadd_ps(value, right, sum[r][1]);
      }
    }
#pragma GCC unroll 12
    for (int r = 0; r < kCount; ++r)
      for (int i = 0; i < 2; ++i) {
        float* place = c + r * stride + 16 * i;
        _mm512_storeu_ps(place, add ? _mm512_add_ps(sum[r][i], _mm512_loadu_ps(place)) : sum[r][i]);
      }
  }
};

bool supports(const MatrixDesc& desc, Isa isa) { return isa >= Isa::avx512 && desc.type != DType::i32; }

}  // namespace

extern const LinearKernel kLinearAvx512;
const LinearKernel kLinearAvx512 = {
    {"avx512", nullptr, nullptr}, supports, LinearLoop<Avx512Tile>::run, LinearLoop<Avx512Tile>::kScratchSize};

}  // namespace vla::kernels
#endif

// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/int8_loop.h"
#include "kernels/x86/vec_avx2.h"

namespace vla::kernels {
namespace {

/// AVX-VNNI's vpdpbusd: four u8 x s8 products added to int32.
struct FourProducts {
  static constexpr int kRows = 6, kStep = 512;
  static constexpr bool kSigned = false;

  static VLA_INLINE void add(__m256i& sum, __m256i numbers, __m256i codes) {
    asm("%{vex%} vpdpbusd %2, %1, %0" : "+x"(sum) : "x"(numbers), "x"(codes));
  }
  static VLA_INLINE __m256i total(__m256i sum) { return sum; }
};

/// Products of ternary weights: pairs of byte products are summed to 16 bits, which hold 64 such pairs of at most 2 * 2
/// * 127 each.
struct TwoProducts {
  static constexpr int kRows = 6, kStep = 256;
  static constexpr bool kSigned = false;
  static_assert(kStep / 4 * 2 * 2 * 127 <= 32767);

  static VLA_INLINE void add(__m256i& sum, __m256i numbers, __m256i codes) {
    __m256i pairs;  // with intrinsics, compilers add pairs to each other first and run out of registers
    asm("vpmaddubsw %3, %2, %1\n\tvpaddw %1, %0, %0" : "+x"(sum), "=&x"(pairs) : "x"(numbers), "x"(codes));
  }
  static VLA_INLINE __m256i total(__m256i sum) { return _mm256_madd_epi16(sum, _mm256_set1_epi16(1)); }
};

/// Products of int8 weights: the sum of two products of bytes up to 255 with codes does not fit into 16 bits. So the
/// code takes the weight's sign (a code is never -128), and the weight becomes its magnitude, at most 128. Pairs are
/// widened to 32 bits immediately.
struct SignedProducts {
  static constexpr int kRows = 5, kStep = 1024;
  static constexpr bool kSigned = true;
  static_assert(2 * 128 * 127 <= 32767);

  static VLA_INLINE void add(__m256i& sum, __m256i numbers, __m256i codes) {
    const __m256i weights = _mm256_xor_si256(numbers, _mm256_set1_epi8(-128));
    const __m256i pairs = _mm256_maddubs_epi16(_mm256_abs_epi8(weights), _mm256_sign_epi8(codes, weights));
    sum = _mm256_add_epi32(sum, _mm256_madd_epi16(pairs, _mm256_set1_epi16(1)));
  }
  static VLA_INLINE __m256i total(__m256i sum) { return sum; }
};

/// A tile of rows by 2 vectors of sums.
template <class Products>
struct Avx2Tile {
  using V = Avx2;
  static constexpr int kRows = Products::kRows, kColumns = 16, kBlockRows = 216 / kRows * kRows,
                       kStep = Products::kStep;
  static constexpr std::int64_t kBlockKiB = 640;
  static constexpr bool kEven = true, kBeside = false, kSigned = Products::kSigned;
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
                   std::int32_t* sums, bool add) {
    __m256i sum[kCount][2];
#pragma GCC unroll 6
    for (int r = 0; r < kCount; ++r) sum[r][0] = sum[r][1] = _mm256_setzero_si256();
    for (std::int64_t k = 0; k < depth; k += Int8Panels::kGroup)
#pragma GCC unroll 4
      for (int s = 0; s < 4; ++s, x += 4) {
        const __m256i left = strips.template load<__m256i>(k, s, 0, 0);
        const __m256i right = strips.template load<__m256i>(k, s, 0, 32);
#pragma GCC unroll 6
        for (int r = 0; r < kCount; ++r) {
          std::int32_t four;
          std::memcpy(&four, x + r * x_stride, sizeof(four));
          const __m256i codes = _mm256_set1_epi32(four);
          Products::add(sum[r][0], left, codes);
          Products::add(sum[r][1], right, codes);
        }
      }
#pragma GCC unroll 6
    for (int r = 0; r < kCount; ++r)
      for (int i = 0; i < 2; ++i) {
        auto* place = reinterpret_cast<__m256i*>(sums + r * kColumns + 8 * i);
        const __m256i total = Products::total(sum[r][i]);
        _mm256_storeu_si256(place, add ? _mm256_add_epi32(total, _mm256_loadu_si256(place)) : total);
      }
  }
};

/// The same for many rows, without the product of signs: code ^ sign is -code - 1 if the weight is negative, so a sum
/// is too small by the magnitudes of its column's negative weights. Magnitudes, signs and these corrections are
/// computed once per step of the depth.
struct SignedTile : Avx2Tile<SignedProducts> {
  /// For every four elements of 16 columns, a line of magnitudes and a line of signs; the sign of a negative weight has
  /// all bits set. After all lines come the corrections of the columns' sums.
  struct Panel {
    static constexpr std::int64_t kSize = 2 * kStep * kColumns + kColumns * 4;
    const std::byte* lines;
  };
  static_assert(2 * 128 * 127 <= 32767 && 2 * 128 * -128 >= -32768);

  template <class Strips>
  static void expand(const Strips& strips, std::int64_t depth, std::byte* to) {
    __m256i lack[2] = {_mm256_setzero_si256(), _mm256_setzero_si256()};
    std::byte* line = to;
    for (std::int64_t k = 0; k < depth; k += Int8Panels::kGroup)
      for (int s = 0; s < 4; ++s, line += 2 * Int8Panels::kLine)
#pragma GCC unroll 2
        for (int i = 0; i < 2; ++i) {
          const __m256i weights = strips.template load<__m256i>(k, s, 0, 32 * i) ^ _mm256_set1_epi8(-128);
          const __m256i size = _mm256_abs_epi8(weights), sign = _mm256_cmpgt_epi8(_mm256_setzero_si256(), weights);
          _mm256_store_si256(reinterpret_cast<__m256i*>(line + 32 * i), size);
          _mm256_store_si256(reinterpret_cast<__m256i*>(line + Int8Panels::kLine + 32 * i), sign);
          const __m256i pairs = _mm256_maddubs_epi16(size & sign, _mm256_set1_epi8(1));
          lack[i] = _mm256_add_epi32(lack[i], _mm256_madd_epi16(pairs, _mm256_set1_epi16(1)));
        }
    std::memcpy(line, lack, sizeof(lack));
  }

  using Avx2Tile::multiply;
  template <class Between>
  static void multiply(int n_row, const std::byte* x, std::int64_t x_stride, const Panel& panel, std::int64_t depth,
                       std::int32_t* sums, bool add, const Between&) {
    with_height<kRows>(n_row, [&]<int n>() { many<n>(x, x_stride, panel.lines, depth, sums, add); });
  }

 private:
  template <int kCount>
  static void many(const std::byte* x, std::int64_t x_stride, const std::byte* lines, std::int64_t depth,
                   std::int32_t* sums, bool add) {
    const auto vector = [&](int i) VLA_LAMBDA { return reinterpret_cast<const __m256i*>(lines) + i; };
    const __m256i ones = _mm256_set1_epi16(1);
    __m256i sum[kCount][2];
#pragma GCC unroll 5
    for (int r = 0; r < kCount; ++r) sum[r][0] = sum[r][1] = _mm256_setzero_si256();
    for (const std::byte* const end = x + depth; x < end;)
      for (const std::byte* const unit = x + kQuantizedUnit; x < unit;)  // a loop of its own keeps the code short
#pragma GCC unroll 4
        for (int s = 0; s < 4; ++s, x += 4, lines += 2 * Int8Panels::kLine) {
          const __m256i left = _mm256_load_si256(vector(0)), right = _mm256_load_si256(vector(1));
#pragma GCC unroll 5
          for (int r = 0; r < kCount; ++r) {
            std::int32_t four;
            std::memcpy(&four, x + r * x_stride, sizeof(four));
            add_both(sum[r], _mm256_set1_epi32(four), left, right, vector(2), ones);
          }
        }
#pragma GCC unroll 5
    for (int r = 0; r < kCount; ++r)
#pragma GCC unroll 2
      for (int i = 0; i < 2; ++i) {
        auto* place = reinterpret_cast<__m256i*>(sums + r * kColumns + 8 * i);
        const __m256i total = _mm256_add_epi32(sum[r][i], _mm256_load_si256(vector(i)));
        _mm256_storeu_si256(place, add ? _mm256_add_epi32(total, _mm256_loadu_si256(place)) : total);
      }
  }

  /// Adds the products of a line. Signs are read from memory, and the two chains alternate: how many instructions a
  /// core can start and how many can wait limit the rate before the multipliers do, most of all where another thread
  /// shares the core. With intrinsics, compilers run out of registers.
  static VLA_INLINE void add_both(__m256i (&sum)[2], __m256i codes, __m256i left, __m256i right, const __m256i* signs,
                                  __m256i ones) {
    __m256i pairs;
    asm("vpxor %5, %2, %3\n\tvpxor %6, %2, %2\n\t"
        "vpmaddubsw %3, %7, %3\n\tvpmaddubsw %2, %8, %2\n\t"
        "vpmaddwd %4, %3, %3\n\tvpmaddwd %4, %2, %2\n\t"
        "vpaddd %3, %0, %0\n\tvpaddd %2, %1, %1"
        : "+x"(sum[0]), "+x"(sum[1]), "+&x"(codes), "=&x"(pairs)
        : "x"(ones), "m"(signs[0]), "m"(signs[1]), "x"(left), "x"(right));
  }
};

/// Products of int4 weights: pairs of code products are summed to 16 bits, from which eight times the block's sum of x
/// is subtracted, because code 8 stands for zero. The difference, at most 32 * 7 * 127, fits into 16 bits and is
/// multiplied by the block's step.
struct Int4Tile {
  using V = Avx2;
  static constexpr int kRows = 6, kColumns = 16, kBlockRows = 216, kStep = 1024, kBlock = Int4Block::kElements;
  static constexpr std::int64_t kBlockKiB = 640;
  static constexpr bool kEven = true, kBeside = false, kSigned = true;
  static constexpr RoundedLayout kLayout = RoundedLayout::none;
  static_assert(kBlock / 2 * Int4Block::kMost * 127 <= 32767);
  struct Session {};

  template <class Strips, class Between>
  static void multiply(int n_row, const std::byte* x, std::int64_t x_stride, const Strips& strips, std::int64_t depth,
                       std::int32_t* sums, bool add, const Between&) {
    with_height<kRows>(n_row, [&]<int n>() {
      for (std::int64_t k = 0; k < depth; k += kBlock) block<n>(x + k, x_stride, strips, k, sums, add || k > 0);
    });
  }

 private:
  template <int kCount, class Strips>
  static VLA_INLINE void block(const std::byte* x, std::int64_t x_stride, const Strips& strips, std::int64_t first,
                               std::int32_t* sums, bool add) {
    __m256i sum[kCount][2];
#pragma GCC unroll 6
    for (int r = 0; r < kCount; ++r) sum[r][0] = sum[r][1] = minus_zeros(x + r * x_stride);
    for (std::int64_t k = first; k < first + kBlock; k += Int8Panels::kGroup)
#pragma GCC unroll 4
      for (int s = 0; s < 4; ++s, x += 4) {
        const __m256i left = strips.template load<__m256i>(k, s, 0, 0);
        const __m256i right = strips.template load<__m256i>(k, s, 0, 32);
#pragma GCC unroll 6
        for (int r = 0; r < kCount; ++r) {
          std::int32_t four;
          std::memcpy(&four, x + r * x_stride, sizeof(four));
          const __m256i codes = _mm256_set1_epi32(four);
          TwoProducts::add(sum[r][0], left, codes);
          TwoProducts::add(sum[r][1], right, codes);
        }
      }
#pragma GCC unroll 2
    for (int i = 0; i < 2; ++i) {
      const __m256i step = strips.template step<__m256i>(first, 0, 32 * i);
#pragma GCC unroll 6
      for (int r = 0; r < kCount; ++r) {
        auto* place = reinterpret_cast<__m256i*>(sums + r * kColumns + 8 * i);
        const __m256i total = _mm256_madd_epi16(sum[r][i], step);
        _mm256_storeu_si256(place, add ? _mm256_add_epi32(total, _mm256_loadu_si256(place)) : total);
      }
    }
  }

  /// Corrections for the two sums of a column, because code 8 stands for zero.
  static VLA_INLINE __m256i minus_zeros(const std::byte* x) {
    const __m256i zero = _mm256_set1_epi8(Int4Block::kZero);
    const auto* halves = reinterpret_cast<const __m256i*>(x);
    const __m256i eight = _mm256_add_epi16(_mm256_maddubs_epi16(zero, _mm256_loadu_si256(halves)),
                                           _mm256_maddubs_epi16(zero, _mm256_loadu_si256(halves + 1)));
    __m128i four = _mm_add_epi16(_mm256_castsi256_si128(eight), _mm256_extracti128_si256(eight, 1));
    four = _mm_add_epi16(four, _mm_shuffle_epi32(four, 0b01001110));
    four = _mm_add_epi16(four, _mm_shuffle_epi32(four, 0b10110001));
    return _mm256_sub_epi16(_mm256_setzero_si256(), _mm256_broadcastd_epi32(four));
  }
};

bool supports_vnni(const MatrixDesc& desc, Features use) { return !is_float(desc.type) && use.has(Feature::avx_vnni); }
bool supports(const MatrixDesc& desc, Features use) { return !is_float(desc.type) && use.has(Feature::avx2); }

}  // namespace

extern const LinearKernel kTernaryAvxVnni, kTernaryAvx2, kInt4AvxVnni, kInt4Avx2, kInt8AvxVnni, kInt8Avx2;
const LinearKernel kTernaryAvxVnni =
    Int8Loop<Avx2Tile<FourProducts>, TernaryPanels>::kernel("avxvnni_int8", supports_vnni);
const LinearKernel kTernaryAvx2 = Int8Loop<Avx2Tile<TwoProducts>, TernaryPanels>::kernel("avx2_int8", supports);
const LinearKernel kInt4AvxVnni = Int8Loop<Avx2Tile<FourProducts>, Int4Panels>::kernel("avxvnni_int8", supports_vnni);
const LinearKernel kInt4Avx2 = Int8Loop<Int4Tile, Int4Codes>::kernel("avx2_int8", supports);
const LinearKernel kInt8AvxVnni = Int8Loop<Avx2Tile<FourProducts>, BytePanels>::kernel("avxvnni_int8", supports_vnni);
const LinearKernel kInt8Avx2 = Int8Loop<SignedTile, BytePanels>::kernel("avx2_int8", supports);

}  // namespace vla::kernels

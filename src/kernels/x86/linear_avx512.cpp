// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/x86/linear_avx512_tile.h"

namespace vla::kernels {
namespace {

/// 12 rows by 2 vectors: 24 sums. Elements of a panel are widened as they are loaded, so that a step takes half of L1
/// and leaves the rest to x.
struct Avx512Tile {
  using V = Avx512;
  using X = float;
  static constexpr int kRows = kAvx512Rows, kColumns = 32;
  static constexpr int kMaxDepth = 2048, kStep = 256, kBlockRows = 96;
  // not a multiple of a page, so that rows do not compete for the same cache lines
  static constexpr int kXStride = kMaxDepth + 16;
  static constexpr bool kEven = true, kRounds = false;

  static VLA_INLINE void copy(const float* from, std::int64_t n, float* to) { copy_padded(from, n, to); }

  static void multiply(DType type, int n_row, const float* x, const std::byte* panel, std::int64_t depth, float* c,
                       bool add, const Prefetch& ahead) {
    const auto rows = type == DType::bf16  ? multiply_rows<Pairs>
                      : type == DType::f16 ? multiply_rows<Halves>
                                           : multiply_rows<Floats>;
    rows(n_row, x, panel, depth, c, add, ahead);
  }

 private:
  struct Number {
    using X = float;
    static constexpr int kCount = 1, kXStride = Avx512Tile::kXStride;
    static VLA_INLINE __m512 everywhere(const float* x) { return _mm512_set1_ps(*x); }
    static VLA_INLINE void add(__m512& sum, __m512 value, __m512 numbers) {
#ifdef VLA_EMULATED_INSTRUCTIONS  // in plain C++ for tests
      sum = _mm512_fmadd_ps(value, numbers, sum);
#else  // with the intrinsic, GCC 12 moves sums between registers
      asm("vfmadd231ps %2, %1, %0" : "+v"(sum) : "v"(value), "v"(numbers));
#endif
    }
  };
  // `load` returns element k of 16 columns as floats. It uses all-ones masks, because for the unmasked form GCC 12
  // warns about undefined lanes in its own header.
  struct Pairs : Number {
    static constexpr int kBlock = 32, kSize = 2;
    static VLA_INLINE __m512 load(const std::byte* p, int k) {
      const __m512i words = _mm512_loadu_si512(p + 64 * (k / 2));
      return std::bit_cast<__m512>(k % 2 == 0 ? _mm512_maskz_slli_epi32(0xffff, words, 16)
                                              : _mm512_and_si512(words, _mm512_set1_epi32(-0x10000)));
    }
  };
  struct Halves : Number {
    static constexpr int kBlock = 32, kSize = 2;
    static VLA_INLINE __m512 load(const std::byte* p, int k) {
      return _mm512_maskz_cvtph_ps(0xffff, _mm256_loadu_si256(reinterpret_cast<const __m256i*>(p + 32 * k)));
    }
  };
  struct Floats : Number {
    static constexpr int kBlock = 16, kSize = 4;
    static VLA_INLINE __m512 load(const std::byte* p, int k) { return _mm512_loadu_ps(p + 64 * k); }
  };
};

bool supports(const MatrixDesc& desc, Features use) { return use.has(Feature::avx512) && is_float(desc.type); }

}  // namespace

extern const LinearKernel kLinearAvx512;
const LinearKernel kLinearAvx512 = LinearLoop<Avx512Tile>::kernel("avx512", supports);

}  // namespace vla::kernels

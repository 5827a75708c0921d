// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/linear_loop.h"
#include "kernels/x86/linear_avx512_tile.h"
#include "kernels/x86/rounding_avx512.h"

namespace vla::kernels {
namespace {

/// 12 rows by 2 vectors: 24 sums. One instruction multiplies a pair of x by the pairs of 16 columns, as panels store
/// them.
struct Avx512Bf16Tile {
  using V = Avx512;
  using X = std::uint16_t;
  static constexpr int kRows = kAvx512Rows, kColumns = 32;
  static constexpr int kMaxDepth = 2048, kStep = 384, kBlockRows = 192;
  static constexpr int kXStride = kMaxDepth + 32;
  static constexpr bool kEven = true, kRounds = true;

  static VLA_INLINE void store_rounded(X* to, V::Float x, std::int64_t left) { store_bf16(to, x, left); }

  static VLA_INLINE void copy(const float* from, std::int64_t n, X* to) {
    for (std::int64_t i = 0; i < n; i += 32)
      store_bf16(to + i, load<V>(from + i, n - i), n - i > 16 ? load<V>(from + i + 16, n - i - 16) : V::Float{});
  }

  static VLA_INLINE void copy(const X* from, std::int64_t n, X* to) { copy_padded(from, n, to); }

  static void multiply(DType, int n_row, const X* x, const std::byte* panel, std::int64_t depth, float* c, bool add,
                       const Prefetch& ahead) {
    multiply_rows<Pairs>(n_row, x, panel, depth, c, add, ahead);
  }

 private:
  struct Pairs {
    using X = std::uint16_t;
    static constexpr int kCount = 2, kXStride = Avx512Bf16Tile::kXStride, kBlock = 32, kSize = 2;
    static VLA_INLINE __m512bh load(const std::byte* p, int k) {
      __m512bh pairs;
      std::memcpy(&pairs, p + 64 * k, sizeof(pairs));
      return pairs;
    }
    static VLA_INLINE __m512i everywhere(const X* x) {
      std::int32_t pair;
      std::memcpy(&pair, x, sizeof(pair));
      return _mm512_set1_epi32(pair);
    }
    static VLA_INLINE void add(__m512& sum, __m512i pair, __m512bh numbers) {
      sum = _mm512_dpbf16_ps(sum, numbers, std::bit_cast<__m512bh>(pair));
    }
  };
};

/// Up to this many rows, reading weights is the bottleneck: kLinearAvx512 multiplies, with x in float32.
constexpr std::int64_t kMaxFew = 16;

bool supports(const MatrixDesc& desc, Features use) {
  return use.has(Feature::avx512_bf16) && desc.type == DType::bf16;
}

}  // namespace

extern const LinearKernel kLinearAvx512, kLinearAvx512Bf16;
const LinearKernel kLinearAvx512Bf16 =
    LinearLoop<Avx512Bf16Tile>::kernel("avx512_bf16", supports, &kLinearAvx512, kMaxFew);

}  // namespace vla::kernels

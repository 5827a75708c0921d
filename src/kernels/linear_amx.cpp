// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#if defined(__x86_64__)
#include "kernels/amx_tiles.h"
#include "kernels/linear_pairs.h"

namespace vla::kernels {
namespace {

/// 32 rows by 32 columns: four tiles of sums, two of x and two of the panel; sums are float32.
struct AmxTile : PairTile {
  using V = Avx512;
  using Session = AmxSession;

  static VLA_INLINE void store_rounded(X* to, V::Float x, std::int64_t left) { store_bf16(to, x, left); }

  static VLA_INLINE void copy(const float* from, std::int64_t n, X* to, X* rest) {
    for (std::int64_t i = 0; i < n; i += 32) {
      const V::Float a = load<V>(from + i, n - i), b = n - i > 16 ? load<V>(from + i + 16, n - i - 16) : V::Float{};
      store_bf16(to + i, a, b);
      if (rest != nullptr) store_bf16(rest + i, a - rounded(a), b - rounded(b));
    }
  }

  static void multiply(DType, int n_row, const X* x, const X* rest, const std::byte* panel, std::int64_t depth,
                       float* c, bool add, const Ahead& ahead) {
    // Rows beyond x are multiplied too; their sums are not read.
    if (rest != nullptr)
      n_row > 16 ? product<true, true>(x, rest, panel, depth, c, add, ahead.from)
                 : product<false, true>(x, rest, panel, depth, c, add, ahead.from);
    else
      n_row > 16 ? product<true, false>(x, rest, panel, depth, c, add, ahead.from)
                 : product<false, false>(x, rest, panel, depth, c, add, ahead.from);
  }

 private:
  /// To the nearest bf16, ties to even, as a float.
  static VLA_INLINE V::Float rounded(V::Float x) {
    const auto bits = std::bit_cast<V::Int>(x);
    return std::bit_cast<V::Float>((bits + 0x7fff + ((bits >> 16) & 1)) & ~0xffff);
  }

  static constexpr std::size_t kLineX = kXStride * sizeof(X), kLineC = kColumns * sizeof(float);

  /// All 32 rows, or the first 16; with what the rounding of x left, or without.
  template <bool kAll, bool kSplit>
  static VLA_INLINE void product(const X* x, const X* rest, const std::byte* panel, std::int64_t depth, float* c,
                                 bool add, const std::byte* ahead) {
    // Bytes of the panel's next step to ask for with each two blocks: the rows of x share them.
    constexpr int kAhead = kSplit ? 1024 : 512;
    float* lower = c + 16 * kColumns;
    before_tile_loads();
    if (add) {
      _tile_loadd(0, c, kLineC);
      _tile_loadd(1, c + 16, kLineC);
      if constexpr (kAll) {
        _tile_loadd(2, lower, kLineC);
        _tile_loadd(3, lower + 16, kLineC);
      }
    } else {
      _tile_zero(0);
      _tile_zero(1);
      _tile_zero(2);
      _tile_zero(3);
    }
    for (std::int64_t k = 0; k < depth; k += kPanelDepth, panel += 2 * kPanelBlock, ahead += kAhead) {
      _tile_loadd(6, panel, 64);
      _tile_loadd(7, panel + kPanelBlock, 64);
      add_products<kAll>(x + k);
      if constexpr (kSplit) add_products<kAll>(rest + k);
      for (int line = 0; line < kAhead; line += 64) __builtin_prefetch(ahead + line, 0, 2);  // to the second cache
    }
    _tile_stored(0, c, kLineC);
    _tile_stored(1, c + 16, kLineC);
    if constexpr (kAll) {
      _tile_stored(2, lower, kLineC);
      _tile_stored(3, lower + 16, kLineC);
    }
  }

  template <bool kAll>
  static VLA_INLINE void add_products(const X* x) {
    _tile_loadd(4, x, kLineX);
    _tile_dpbf16ps(0, 4, 6);
    _tile_dpbf16ps(1, 4, 7);
    if constexpr (kAll) {
      _tile_loadd(5, x + 16 * kXStride, kLineX);
      _tile_dpbf16ps(2, 5, 6);
      _tile_dpbf16ps(3, 5, 7);
    }
  }
};

bool supports(const MatrixDesc& desc, Isa isa) { return isa >= Isa::amx && desc.type == DType::bf16; }

}  // namespace

extern const LinearKernel kLinearAmx;
const LinearKernel kLinearAmx = LinearLoop<AmxTile>::kernel("amx", supports);

}  // namespace vla::kernels
#endif

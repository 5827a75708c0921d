// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/linear_tiles.h"
#include "kernels/x86/amx_tiles.h"

namespace vla::kernels {
namespace {

/// A square of float32 sums takes four tiles; a square of x and a square of a panel take two each.
struct AmxTile : AmxRounding {
  using Session = AmxSession;

  static VLA_INLINE void copy(const float* from, std::int64_t n, std::uint16_t* to) {
    store_bf16(to, load<V>(from, n), n > 16 ? load<V>(from + 16, n - 16) : V::Float{});
  }

  template <class Between>
  static VLA_INLINE void multiply(bool half, const std::uint16_t* x, const std::byte* panel, std::int64_t n_square,
                                  float* c, bool add, Between& between) {
    half ? product<false>(x, panel, n_square, c, add, between) : product<true>(x, panel, n_square, c, add, between);
  }

 private:
  static constexpr std::size_t kLineX = kTileSide * sizeof(std::uint16_t), kLineC = kTileSide * sizeof(float);
  static constexpr std::int64_t kHalf = kTileSide / 2 * kTileSide;  // offset of a square's upper half in elements

  /// Multiplies all 32 rows or the first 16. x bypasses L1, where the panel stays for the next rows.
  template <bool kAll, class Between>
  static VLA_INLINE void product(const std::uint16_t* x, const std::byte* panel, std::int64_t n_square, float* c,
                                 bool add, Between& between) {
    KeepVectorUnitPowered vectors;
    before_tile_loads();
    if (add) {
      _tile_loadd(0, c, kLineC);
      _tile_loadd(1, c + 16, kLineC);
      if constexpr (kAll) {
        _tile_loadd(2, c + kHalf, kLineC);
        _tile_loadd(3, c + kHalf + 16, kLineC);
      }
    } else {
      _tile_zero(0);
      _tile_zero(1);
      _tile_zero(2);
      _tile_zero(3);
    }
    for (std::int64_t i = 0; i < n_square; ++i, x += 2 * kHalf, panel += 2 * kPanelBlock) {
      _tile_loadd(6, panel, 64);
      _tile_stream_loadd(4, x, kLineX);
      _tile_loadd(7, panel + kPanelBlock, 64);
      _tile_dpbf16ps(0, 4, 6);
      if constexpr (kAll) _tile_stream_loadd(5, x + kHalf, kLineX);
      _tile_dpbf16ps(1, 4, 7);
      vectors.keep();
      between();
      if constexpr (kAll) {
        _tile_dpbf16ps(2, 5, 6);
        _tile_dpbf16ps(3, 5, 7);
      }
    }
    _tile_stored(0, c, kLineC);
    _tile_stored(1, c + 16, kLineC);
    if constexpr (kAll) {
      _tile_stored(2, c + kHalf, kLineC);
      _tile_stored(3, c + kHalf + 16, kLineC);
    }
  }
};

/// Up to this many rows, reading weights is the bottleneck: kLinearAvx512 multiplies, with x in float32.
constexpr std::int64_t kMaxFew = 16;

bool supports(const MatrixDesc& desc, Features use) { return use.has(Feature::amx_bf16) && desc.type == DType::bf16; }

}  // namespace

extern const LinearKernel kLinearAvx512, kLinearAmx;
const LinearKernel kLinearAmx = TileLoop<AmxTile>::kernel("amx", supports, &kLinearAvx512, kMaxFew);

}  // namespace vla::kernels

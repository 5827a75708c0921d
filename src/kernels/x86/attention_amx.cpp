// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/attention_tile.h"
#include "kernels/x86/amx_tiles.h"

namespace vla::kernels {
namespace {

/// 32 rows by 32 columns: four tiles of sums, two of rows and two of the panel.
struct AmxTile {
  using Session = AmxSession;

  static VLA_INLINE void store(std::uint16_t* to, Avx512::Float a, Avx512::Float b) { store_bf16(to, a, b); }

  static VLA_INLINE void open(const float* c, int stride, bool sum) {
    if (!sum) {
      _tile_zero(0);
      _tile_zero(1);
      _tile_zero(2);
      _tile_zero(3);
      return;
    }
    before_tile_loads();
    const std::size_t line = sizeof(*c) * static_cast<std::size_t>(stride);
    _tile_loadd(0, c, line);
    _tile_loadd(1, c + 16, line);
    _tile_loadd(2, c + 16 * stride, line);
    _tile_loadd(3, c + 16 * stride + 16, line);
  }

  static VLA_INLINE void step(const std::uint16_t* a, int stride, const std::uint16_t* panel) {
    before_tile_loads();
    const std::size_t line = sizeof(*a) * static_cast<std::size_t>(stride);
    _tile_loadd(4, a, line);
    _tile_loadd(6, panel, 64);
    _tile_loadd(7, panel + 512, 64);
    _tile_dpbf16ps(0, 4, 6);
    _tile_dpbf16ps(1, 4, 7);
    _tile_loadd(5, a + 16 * stride, line);
    _tile_dpbf16ps(2, 5, 6);
    _tile_dpbf16ps(3, 5, 7);
  }

  static VLA_INLINE void close(float* c, int stride) {
    const std::size_t line = sizeof(*c) * static_cast<std::size_t>(stride);
    _tile_stored(0, c, line);
    _tile_stored(1, c + 16, line);
    _tile_stored(2, c + 16 * stride, line);
    _tile_stored(3, c + 16 * stride + 16, line);
  }
};

using Attention = AttentionTile<PairProducts<Avx512, AmxTile>>;

}  // namespace

extern const AttentionKernel kAttentionAmx;
const AttentionKernel kAttentionAmx = Attention::kernel();

}  // namespace vla::kernels

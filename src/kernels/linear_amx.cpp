// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#if defined(__x86_64__)
#include "kernels/linear_kernel.h"
#include "kernels/linear_pairs.h"

namespace vla::kernels {
namespace {

/// 32 rows by 32 columns: four tiles of sums, two of x and two of the panel. x is rounded to bf16, as PyTorch rounds
/// the activations of a bf16 layer; sums are float32.
struct AmxTile : PairPanels {
  using V = Avx512;

  /// The shapes of the eight tiles, all 16 lines of 64 bytes, which the processor keeps for a thread until released.
  struct Session {
    VLA_INLINE Session() {
      struct alignas(64) {
        std::uint8_t palette = 1, start_row = 0, reserved[14] = {};
        std::uint16_t bytes[16] = {};
        std::uint8_t lines[16] = {};
      } config;
      for (int i = 0; i < 8; ++i) config.bytes[i] = 64, config.lines[i] = 16;
      _tile_loadconfig(&config);
    }
    VLA_INLINE ~Session() { _tile_release(); }
  };

  static void multiply(DType, int n_row, const std::uint16_t* x, const std::byte* panel, std::int64_t depth, float* c,
                       std::int64_t stride, bool add) {
    if (n_row == kRows) return multiply_rows<true>(x, panel, depth, c, stride, add);
    alignas(64) float sums[kRows * kColumns];  // of rows that x does not have, too
    if (n_row > 16)
      multiply_rows<true>(x, panel, depth, sums, kColumns, false);
    else
      multiply_rows<false>(x, panel, depth, sums, kColumns, false);
    for (int r = 0; r < n_row; ++r)
      for (int n = 0; n < kColumns; n += V::width) {
        float* place = c + r * stride + n;
        const V::Float sum = V::load(sums + r * kColumns + n);
        V::store(place, add ? V::load(place) + sum : sum);
      }
  }

 private:
  /// All 32 rows, or the first 16.
  template <bool kAll>
  static VLA_INLINE void multiply_rows(const std::uint16_t* x, const std::byte* panel, std::int64_t depth, float* c,
                                       std::int64_t stride, bool add) {
    const auto line = static_cast<std::size_t>(stride) * sizeof(float);
    float* lower = c + 16 * stride;
    if (add) {
      _tile_loadd(0, c, line);
      _tile_loadd(1, c + 16, line);
      if constexpr (kAll) {
        _tile_loadd(2, lower, line);
        _tile_loadd(3, lower + 16, line);
      }
    } else {
      _tile_zero(0);
      _tile_zero(1);
      _tile_zero(2);
      _tile_zero(3);
    }
    for (std::int64_t k = 0; k < depth; k += kDepth, panel += 2048) {
      _tile_loadd(4, x + k, kXStride * sizeof(std::uint16_t));
      _tile_loadd(6, panel, 64);
      _tile_loadd(7, panel + 1024, 64);
      _tile_dpbf16ps(0, 4, 6);
      _tile_dpbf16ps(1, 4, 7);
      if constexpr (kAll) {
        _tile_loadd(5, x + 16 * kXStride + k, kXStride * sizeof(std::uint16_t));
        _tile_dpbf16ps(2, 5, 6);
        _tile_dpbf16ps(3, 5, 7);
      }
    }
    _tile_stored(0, c, line);
    _tile_stored(1, c + 16, line);
    if constexpr (kAll) {
      _tile_stored(2, lower, line);
      _tile_stored(3, lower + 16, line);
    }
  }
};

bool supports(const MatrixDesc& desc, Isa isa) { return isa >= Isa::amx && desc.type == DType::bf16; }

}  // namespace

extern const LinearKernel kLinearAmx;
const LinearKernel kLinearAmx = {{"amx", LinearLoop<AmxTile>::packed_size, LinearLoop<AmxTile>::pack},
                                 supports,
                                 LinearLoop<AmxTile>::run,
                                 LinearLoop<AmxTile>::kScratchSize};

}  // namespace vla::kernels
#endif

// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "cuda/kernels/device.h"
#include "cuda/kernels/linear_int8.h"

namespace vla::cuda {

/// Four ternary codes of a word, plus 1, as bytes.
VLA_DEVICE unsigned ternary_fragment(unsigned word, int i) { return word >> 2 * i & 0x03030303U; }

/// The codes of a packed tile (Int8Tile) that a lane owns: one column of every eight.
template <CodeKind kKind>
class LaneCodes {
 public:
  LaneCodes() = default;
  /// read(T{}, offset) returns the T at an offset in bytes from the tile.
  template <class Read>
  VLA_DEVICE explicit LaneCodes(Read read) {
    const int lane = thread_index() % kLanes;
#pragma unroll
    for (int i = 0; i < kWords / 4; ++i) {
      const uint4 four = read(uint4{}, i * 512 + lane * 16);
      words_[4 * i] = four.x, words_[4 * i + 1] = four.y, words_[4 * i + 2] = four.z, words_[4 * i + 3] = four.w;
    }
    if constexpr (kKind == CodeKind::int4) steps_ = read(0U, kWords * 128 + lane / 4 * 4);
  }
  /// Four codes as signed bytes; ternary ones plus 1.
  VLA_DEVICE unsigned fragment(int eight, int i) const {
    if constexpr (kKind == CodeKind::ternary) return ternary_fragment(words_[eight], i);
    if constexpr (kKind == CodeKind::int4) {
      // (code - 8) * step + 128 is an unsigned byte, so one multiplication makes four of them.
      const unsigned codes = words_[2 * eight + i / 2] >> i % 2 * 4 & 0x0f0f0f0fU, step = steps_ >> 8 * eight & 255;
      return (codes * step + (0x80808080U - step * 0x08080808U)) ^ 0x80808080U;
    }
    if constexpr (kKind == CodeKind::int8) return words_[4 * eight + i];
  }

 private:
  static constexpr int kWords = kKind == CodeKind::ternary ? 4 : kKind == CodeKind::int4 ? 8 : 16;
  unsigned words_[kWords], steps_ = 0;
};

}  // namespace vla::cuda

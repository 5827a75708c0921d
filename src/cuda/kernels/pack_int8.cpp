// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <cstring>

#include "cuda/kernels/linear_int8.h"

namespace vla::cuda {

std::size_t packed_int8_size(CodeKind kind, std::int64_t d_in, std::int64_t d_out) {
  const std::int64_t n_tile =
      round_up(d_out, Int8Tile::kColumns) / Int8Tile::kColumns * (round_up(d_in, Int8Tile::kDepth) / Int8Tile::kDepth);
  return static_cast<std::size_t>(n_tile * (kind == CodeKind::ternary ? Int8Tile::kTernaryBytes : Int8Tile::kBytes));
}

void pack_int8(CodeKind kind, const std::byte* stored, std::int64_t d_in, std::int64_t d_out, std::byte* packed) {
  const bool ternary = kind == CodeKind::ternary;
  const std::int64_t row = ternary ? (d_in + 3) / 4 : d_in;  // bytes
  const auto element = [&](std::int64_t n, std::int64_t k) {
    if (ternary) return (std::to_integer<int>(stored[n * row + k / 4]) >> k % 4 * 2 & 3) - 1;
    return static_cast<int>(static_cast<std::int8_t>(stored[n * row + k]));
  };
  for (std::int64_t column0 = 0; column0 < d_out; column0 += Int8Tile::kColumns)
    for (std::int64_t depth0 = 0; depth0 < d_in; depth0 += Int8Tile::kDepth)
      for (int i = 0; i < (ternary ? Int8Tile::kTernaryBytes : Int8Tile::kBytes); ++i, ++packed) {
        // int8: eight columns, lane, fragment, byte. Ternary: lane, eight columns, byte, with all fragments in a byte.
        const int lane = ternary ? i / 16 : i / 16 % 32, eight = ternary ? i / 4 % 4 : i / 512, byte = i % 4;
        const auto code = [&](int fragment) {
          const std::int64_t n = column0 + 8 * eight + lane / 4, k = depth0 + 16 * fragment + 4 * (lane % 4) + byte;
          return n < d_out && k < d_in ? element(n, k) : 0;
        };
        int value = ternary ? 0 : code(i / 4 % 4);
        for (int s = 0; ternary && s < 4; ++s) value |= (code(s) + 1) << 2 * s;
        *packed = static_cast<std::byte>(value);
      }
}

}  // namespace vla::cuda

// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cstring>

#include "bundle/encoding.h"
#include "cuda/kernels/linear_int8.h"

namespace vla::cuda {
namespace {

static_assert(Int4Block::kElements == Int8Tile::kDepth);

/// The codes of a tile in rows, as they are packed: ternary plus 1, the four bits of int4, or int8.
struct Tile {
  std::uint8_t code[Int8Tile::kColumns][Int8Tile::kDepth];
  std::uint8_t step[Int8Tile::kColumns] = {};

  Tile(CodeKind kind, std::uint8_t zero) : kind_(kind) { std::memset(code, zero, sizeof(code)); }

  /// stored: the row's elements in the tile, n of them.
  void take(int column, const std::byte* stored, std::int64_t n) {
    std::uint8_t* to = code[column];
    if (kind_ == CodeKind::int8) {
      std::memcpy(to, stored, static_cast<std::size_t>(n));
    } else if (kind_ == CodeKind::ternary) {
      for (std::int64_t k = 0; k < n; ++k)
        to[k] = std::to_integer<std::uint8_t>(stored[k / 4] >> k % 4 * 2 & std::byte{3});
    } else {
      const auto& block = reinterpret_cast<const Int4Block&>(*stored);
      for (std::size_t k = 0; k < static_cast<std::size_t>(n); ++k) to[k] = block.codes[k / 2] >> k % 2 * 4 & 15;
      step[column] = block.step;
    }
  }
  /// The four codes of a lane in a fragment.
  std::uint32_t word(int lane, int eight, int fragment) const {
    std::uint32_t four;
    std::memcpy(&four, &code[8 * eight + lane / 4][16 * fragment + 4 * (lane % 4)], sizeof(four));
    return four;
  }
  void pack(std::byte* to) const {
    const auto add = [&](std::uint32_t word) { std::memcpy(to, &word, sizeof(word)), to += sizeof(word); };
    if (kind_ == CodeKind::ternary)
      for (int lane = 0; lane < 32; ++lane)
        for (int eight = 0; eight < 4; ++eight)
          add(word(lane, eight, 0) | word(lane, eight, 1) << 2 | word(lane, eight, 2) << 4 | word(lane, eight, 3) << 6);
    if (kind_ == CodeKind::int8)
      for (int eight = 0; eight < 4; ++eight)
        for (int lane = 0; lane < 32; ++lane)
          for (int i = 0; i < 4; ++i) add(word(lane, eight, i));
    if (kind_ != CodeKind::int4) return;
    for (int pair = 0; pair < 4; pair += 2)
      for (int lane = 0; lane < 32; ++lane)
        for (int eight = pair; eight < pair + 2; ++eight)
          for (int i = 0; i < 4; i += 2) add(word(lane, eight, i) | word(lane, eight, i + 1) << 4);
    for (int i = 0; i < 8; ++i)
      add(step[i] | step[8 + i] << 8 | step[16 + i] << 16 | static_cast<std::uint32_t>(step[24 + i]) << 24);
  }

 private:
  CodeKind kind_;
};

}  // namespace

std::size_t packed_int8_size(CodeKind kind, std::int64_t d_in, std::int64_t d_out) {
  const std::int64_t n_tile =
      round_up(d_out, Int8Tile::kColumns) / Int8Tile::kColumns * (round_up(d_in, Int8Tile::kDepth) / Int8Tile::kDepth);
  return static_cast<std::size_t>(n_tile * tile_bytes(kind));
}

void pack_int8(CodeKind kind, const std::byte* stored, std::int64_t d_in, std::int64_t d_out, std::byte* packed) {
  const DType type = kind == CodeKind::ternary ? DType::ternary : kind == CodeKind::int4 ? DType::int4 : DType::i8;
  const std::uint8_t zero = kind == CodeKind::ternary ? 1 : kind == CodeKind::int4 ? Int4Block::kZero : 0;
  const auto row = static_cast<std::int64_t>(dtype_size(type, d_in));
  for (std::int64_t column = 0; column < d_out; column += Int8Tile::kColumns)
    for (std::int64_t depth = 0; depth < d_in; depth += Int8Tile::kDepth, packed += tile_bytes(kind)) {
      Tile tile(kind, zero);
      for (std::int64_t n = column; n < std::min(column + Int8Tile::kColumns, d_out); ++n)
        tile.take(static_cast<int>(n - column), stored + n * row + static_cast<std::int64_t>(dtype_size(type, depth)),
                  std::min<std::int64_t>(Int8Tile::kDepth, d_in - depth));
      tile.pack(packed);
    }
}

}  // namespace vla::cuda

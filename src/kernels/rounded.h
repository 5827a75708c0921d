// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "kernels/sizes.h"

/// How activations between two products lie in memory where both would round them to bf16 anyway.
namespace vla::kernels {

/// rows: one after the other. tiles: squares of 32 rows by 32 elements, those of the same rows one after the other, as
/// the tile registers of AMX load them. What stands in rows beyond the last does not matter; elements beyond the last
/// of a row are zeros.
enum class RoundedLayout { none, rows, tiles };

constexpr std::int64_t kTileSide = 32;

/// The place of element i of a row among tiles of rows of d elements.
constexpr VLA_INLINE std::int64_t place_in_tiles(std::int64_t row, std::int64_t i, std::int64_t d) {
  return row / kTileSide * kTileSide * round_up(d, kTileSide) + i / kTileSide * kTileSide * kTileSide +
         row % kTileSide * kTileSide + i % kTileSide;
}

/// The place of element i of a row among rows of d elements.
constexpr VLA_INLINE std::int64_t rounded_place(RoundedLayout layout, std::int64_t row, std::int64_t i,
                                                std::int64_t d) {
  return layout == RoundedLayout::tiles ? place_in_tiles(row, i, d) : row * d + i;
}

/// Calls piece(i, place, count) for the parts of elements `column` to column + n of a row that lie together: count
/// elements from the i-th on are at `place`.
template <class Piece>
VLA_INLINE void for_pieces(RoundedLayout layout, std::int64_t row, std::int64_t column, std::int64_t n, std::int64_t d,
                           const Piece& piece) {
  for (std::int64_t i = 0, size = 0; i < n; i += size, column += size) {
    size = min(n - i, kTileSide - column % kTileSide);
    piece(i, rounded_place(layout, row, column, d), size);
  }
}

/// Elements that n_row rows of d take.
constexpr std::int64_t rounded_count(RoundedLayout layout, std::int64_t n_row, std::int64_t d) {
  return layout == RoundedLayout::tiles ? round_up(n_row, kTileSide) * round_up(d, kTileSide) : n_row * d;
}

}  // namespace vla::kernels

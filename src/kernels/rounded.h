// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "kernels/sizes.h"

/// Layouts of activations between two products that would both round them to bf16.
namespace vla::kernels {

/// rows: contiguous rows. tiles: squares of 32 rows by 32 elements, as AMX tile registers load them; the squares of the
/// same rows are consecutive. Rows after the last may hold anything; elements after the last of a row are zeros.
enum class RoundedLayout { none, rows, tiles };

constexpr std::int64_t kTileSide = 32;

/// Offset of element i of a row in tiles of rows of d elements.
constexpr VLA_INLINE std::int64_t place_in_tiles(std::int64_t row, std::int64_t i, std::int64_t d) {
  return row / kTileSide * kTileSide * round_up(d, kTileSide) + i / kTileSide * kTileSide * kTileSide +
         row % kTileSide * kTileSide + i % kTileSide;
}

/// Offset of element i of a row in rows of d elements.
constexpr VLA_INLINE std::int64_t rounded_place(RoundedLayout layout, std::int64_t row, std::int64_t i,
                                                std::int64_t d) {
  return layout == RoundedLayout::tiles ? place_in_tiles(row, i, d) : row * d + i;
}

/// Calls piece(i, place, count) for each contiguous part of elements `column` to column + n of a row: count elements,
/// starting with the i-th, are at `place`.
template <class Piece>
VLA_INLINE void for_pieces(RoundedLayout layout, std::int64_t row, std::int64_t column, std::int64_t n, std::int64_t d,
                           const Piece& piece) {
  for (std::int64_t i = 0, size = 0; i < n; i += size, column += size) {
    size = min(n - i, kTileSide - column % kTileSide);
    piece(i, rounded_place(layout, row, column, d), size);
  }
}

/// Elements that n_row rows of d take in this layout.
constexpr std::int64_t rounded_count(RoundedLayout layout, std::int64_t n_row, std::int64_t d) {
  return layout == RoundedLayout::tiles ? round_up(n_row, kTileSide) * round_up(d, kTileSide) : n_row * d;
}

}  // namespace vla::kernels

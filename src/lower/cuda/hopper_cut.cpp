// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <limits>

#include "cuda/kernels/linear_bf16.h"
#include "cuda/kernels/linear_int8.h"
#include "lower/cuda/cuda_lowering.h"

namespace vla::lower {
namespace {

// Of the data sheet, and assumed: sums over 128 bytes of the depth in a microsecond at 0.85 of the tensor units' peak;
// bytes a microsecond that an SM reads from the second-level cache, and that all write to memory; what a block takes
// before its first product, and a kernel that adds shares of the depth, in microseconds.
constexpr double kSums = 0.85 * 32 * 1755, kOfSm = 56e3, kOfAll = 2.5e6, kBegin = 1.5, kFinish = 2;

/// A tile of a table, and the bytes that a step of 128 bytes of the depth reads.
struct Candidate {
  std::size_t index;
  std::int64_t columns, rows, step_bytes;
};

std::vector<Candidate> candidates(MatrixKind kind, bool is_gated) {
  std::vector<Candidate> all;
  if (kind == MatrixKind::bf16)
    for (std::size_t i = 0; i < std::size(cuda::kHopperTiles); ++i) {
      const auto& [kernel, columns, rows, gated] = cuda::kHopperTiles[i];
      if (gated == is_gated) all.push_back({i, columns, rows, (columns + rows) * 128});
    }
  const bool is_ternary = kind == MatrixKind::ternary;
  if (is_ternary || kind == MatrixKind::int8)
    for (std::size_t i = 0; i < std::size(cuda::kHopperInt8Tiles); ++i) {
      const auto& [kernel, of, columns, rows] = cuda::kHopperInt8Tiles[i];
      if ((of == cuda::CodeKind::ternary) == is_ternary)
        all.push_back({i, columns, rows, (columns / (is_ternary ? 4 : 1) + rows) * 128});
    }
  return all;
}

std::int64_t ceil_of(std::int64_t n, std::int64_t size) { return (n + size - 1) / size; }

}  // namespace

ProductCut cut_for_hopper(MatrixKind kind, std::int64_t n_row, std::int64_t n_column, std::int64_t depth, bool is_gated,
                          int n_sm) {
  const std::int64_t n_step = ceil_of(depth, kind == MatrixKind::bf16 ? cuda::kHopperDepth : cuda::kHopperInt8Depth);
  ProductCut best = {ProductShape::hopper, 1, 0, std::numeric_limits<double>::max()};
  for (const Candidate& tile : candidates(kind, is_gated))
    for (const int n_split : {1, 2, 3, 4, 6, 8}) {
      if (n_split > 1 && n_step / n_split < 4) break;
      const auto size = static_cast<double>(tile.columns * tile.rows);
      const double of_step = std::max(size / kSums, static_cast<double>(tile.step_bytes) / kOfSm);
      const double of_block =
          kBegin + static_cast<double>(ceil_of(n_step, n_split)) * of_step + 4 * size * n_sm / kOfAll;
      const std::int64_t n_block = ceil_of(n_row, tile.rows) * ceil_of(n_column, tile.columns) * n_split;
      double us = static_cast<double>(ceil_of(n_block, n_sm)) * of_block;
      if (n_split > 1) us += kFinish + static_cast<double>(4 * n_row * n_column * (n_split + 1)) / kOfAll;
      if (us < best.us) best.n_split = n_split, best.tile = tile.index, best.us = us;
    }
  return best;
}

}  // namespace vla::lower

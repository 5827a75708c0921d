// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <limits>

#include "cuda/kernels/linear_bf16.h"
#include "cuda/kernels/linear_int8.h"
#include "lower/cuda/cuda_lowering.h"

namespace vla::lower {
namespace {

constexpr double kNever = std::numeric_limits<double>::max();

std::int64_t blocks_of(std::int64_t n_row, std::int64_t n_column, std::int64_t rows, std::int64_t columns) {
  return ceil_div(n_row, rows) * ceil_div(n_column, columns);
}

constexpr double kFinish = 2;  // microseconds of the kernel that adds shares

/// Estimated microseconds of a strip kernel, from measurements on an H200: a warp takes a fixed time per step of the
/// depth; the kernel that adds shares takes kFinish plus the traffic of its sums.
double strip_us(std::int64_t width, int n_split, std::int64_t n_row, std::int64_t n_column, std::int64_t depth,
                int n_sm) {
  constexpr double kBegin = 2, kOfAll = 2.5e6;
  const std::int64_t n_block = blocks_of(n_row, n_column, 64, width) * n_split;
  const std::int64_t n_warp = width <= 32 ? 8 : 256 / width;  // warps that share the depth
  const std::int64_t of_warp = ceil_div(depth, cuda::kBf16Depth * n_warp * n_split);
  const double of_step = width == 16 ? 0.85 : 1.4;
  const double us = kBegin + static_cast<double>(ceil_div(n_block, n_sm) * of_warp) * of_step;
  return n_split == 1 ? us : us + kFinish + static_cast<double>(2 * 4 * n_row * n_column * n_split) / kOfAll;
}

/// The strip width and number of shares with the shortest time, or the strip's that begins a norm.
ProductCut cut_in_strips(std::int64_t n_row, std::int64_t n_column, std::int64_t depth, int n_sm,
                         bool begins_norm = false) {
  using enum cuda::Bf16Shape;
  ProductCut best = {.us = kNever};
  for (const cuda::Bf16Shape shape : {strip16, strip32, strip64, strip128})
    for (const int n_split : {1, 2, 4, 8}) {
      if (n_split > 1 && (begins_norm || depth / n_split < 8 * cuda::kBf16Depth)) break;
      if (begins_norm && shape == strip128) break;
      const double us = strip_us(strip_width(shape), n_split, n_row, n_column, depth, n_sm);
      if (us < best.us) best = {.shape = shape, .n_split = n_split, .us = us};
    }
  return best;
}

}  // namespace

bool is_of_strips(std::int64_t n_row, std::int64_t depth) {
  return n_row > cuda::kBf16FewRows && n_row <= 64 && depth % 8 == 0;
}

unsigned common_width(std::int64_t n_row, std::int64_t n_column, std::int64_t depth, int n_sm) {
  const auto us = [&](unsigned width) { return strip_us(width, 1, n_row, n_column, depth, n_sm); };
  return std::min({16U, 32U, 64U}, [&](unsigned a, unsigned b) { return us(a) < us(b); });
}

ProductCut cut_product(const CudaLowering& l, MatrixKind kind, std::int64_t n_row, std::int64_t n_column,
                       std::int64_t depth, bool is_gated) {
  const int n_sm = l.n_sm;
  const bool is_bf16 = kind == MatrixKind::bf16, is_few = n_row <= (is_bf16 ? cuda::kBf16FewRows : 4);
  // No Hopper tile expands int4 codes.
  const bool has_tiles = l.is_hopper && kind != MatrixKind::f32 && kind != MatrixKind::int4 && !is_few;
  const HopperCutFor tables = is_gated ? HopperCutFor::gated : HopperCutFor::one;
  if (is_bf16 && is_of_strips(n_row, depth)) {
    const ProductCut strips = cut_in_strips(n_row, n_column, depth, n_sm);
    if (!has_tiles) return strips;
    // Measured: tiles of few rows, with the kernel that adds their shares, take this many microseconds more than
    // estimated.
    constexpr double kMore = 1.5;
    const ProductCut tiles = cut_for_hopper(kind, n_row, n_column, depth, tables, n_sm, l.ways);
    return tiles.us + kMore < strips.us ? tiles : strips;
  }
  if (has_tiles) return cut_for_hopper(kind, n_row, n_column, depth, tables, n_sm, l.ways);
  const std::int64_t n_large = blocks_of(n_row, n_column, 128, 128);
  using enum cuda::Bf16Shape;
  const cuda::Bf16Shape shape = is_few ? few : n_row > 64 && n_large >= n_sm ? rows128 : rows64;
  if (kind == MatrixKind::f32) return {shape, 1};
  std::int64_t n_block = shape == rows128 ? n_large : blocks_of(n_row, n_column, 64, 64);
  if (is_few) n_block = blocks_of(1, n_column, 1, is_bf16 ? 8 : 128);
  // A share has at least `least` steps. The depth is split only if there are fewer blocks than SMs. Codes allow fewer
  // steps per share: their steps are twice as deep, and one kernel that adds many shares is faster than the epilogues
  // of a few blocks.
  const std::int64_t step = is_bf16 ? cuda::kBf16Depth : cuda::Int8Tile::kDepth, least = is_bf16 ? 8 : 3;
  const std::int64_t most = std::max<std::int64_t>(ceil_div(depth, step) / least, 1);
  return {shape, static_cast<int>(std::clamp<std::int64_t>(n_sm / std::max<std::int64_t>(n_block, 1), 1, most))};
}

ProductCut cut_to_begin_norm(const CudaLowering& l, std::int64_t n_row, std::int64_t n_column, std::int64_t depth) {
  ProductCut best = {.us = kNever};
  if (is_of_strips(n_row, depth)) best = cut_in_strips(n_row, n_column, depth, l.n_sm, true);
  if (!l.is_hopper) return best;
  const ProductCut tile =
      cut_for_hopper(MatrixKind::bf16, n_row, n_column, depth, HopperCutFor::begins_norm, l.n_sm, l.ways);
  return tile.us < best.us ? tile : best;
}

double us_with_norm(const ProductCut& cut) {
  constexpr double kNorm = 2.5;  // of a small kernel in an act on an H200
  const bool has_finish = !cut.tile && strip_width(cut.shape) > 0 && cut.n_split > 1;
  return cut.us + kNorm - (has_finish ? kFinish : 0);
}

}  // namespace vla::lower

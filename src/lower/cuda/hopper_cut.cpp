// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <limits>

#include "cuda/kernels/hopper_tma.h"
#include "cuda/kernels/linear_int8.h"
#include "lower/cuda/cluster_cost.h"
#include "lower/cuda/cuda_lowering.h"

namespace vla::lower {
namespace {

/// Cost model of a product, in microseconds and rates per microsecond.
struct ProductRates {
  double sums;           // results of a block that advance by one step of the depth
  double of_sm;          // bytes that an SM reads from the L2 cache
  double least;          // minimum time of a step of the depth
  double kernel, block;  // fixed costs of the kernel and of a block
  double first_end;      // once for blocks that write results: fetching the epilogue's instructions
  double end, share;     // per result of a block, and per partial sum of a depth share
  double further;        // the fraction of a block's time that each further block on an SM adds
};
// Fitted to measurements on an H200: bf16 to 930 products of 50 to 2048 rows with float32 results, int8 to 194 and
// ternary to 408; 96, 96 and 89 % of the estimates are within a sixth of the measurement. The chosen tile takes at most
// 1.19 times as long as the best one. Tiles of 48 rows, and gated ones of 64, are not measured; nor are products of
// codes since wgmma takes the codes from registers: the rates are those of kernels that unpacked codes to shared
// memory.
constexpr ProductRates kBf16 = {.sums = 42.7e3,
                                .of_sm = 67.1e3,
                                .least = 0.267,
                                .kernel = 1.57,
                                .block = 0.44,
                                .first_end = 0,
                                .end = 1.46e-4,
                                .share = 5.1e-5,
                                .further = 0.97};
constexpr ProductRates kTernary = {.sums = 34.2e3,
                                   .of_sm = 65e3,
                                   .least = 0.192,
                                   .kernel = 3.78,
                                   .block = 0.03,
                                   .first_end = 0.2,
                                   .end = 2.6e-4,
                                   .share = 9e-6,
                                   .further = 1.21};
constexpr ProductRates kInt8 = {.sums = 51.6e3,
                                .of_sm = 52.6e3,
                                .least = 0.168,
                                .kernel = 2.35,
                                .block = 0.13,
                                .first_end = 0.35,
                                .end = 3.4e-4,
                                .share = 3.5e-5,
                                .further = 1.18};
constexpr double kWritten = 2.5e6;  // bytes that all SMs together write to memory per microsecond

/// A tile of a table, and the bytes that it reads per step of 128 bytes of depth.
struct Candidate {
  std::size_t index;
  std::int64_t columns, rows, step_bytes;
  bool by_tma = false;
};

std::vector<Candidate> candidates(MatrixKind kind, HopperCutFor what) {
  std::vector<Candidate> all;
  if (kind == MatrixKind::bf16)
    for (std::size_t i = 0; i < std::size(cuda::kHopperTiles); ++i) {
      const auto& [kernel, columns, rows, is_gated, several, begins] = cuda::kHopperTiles[i];
      if (is_gated != (what == HopperCutFor::gated)) continue;
      if ((what == HopperCutFor::several && several == nullptr) ||
          (what == HopperCutFor::begins_norm && begins == nullptr))
        continue;
      all.push_back({i, columns, rows, (columns + rows) * 128});
      if (cuda::tma_tile_of(cuda::kHopperTiles[i]) != nullptr)
        all.push_back({i, columns, rows, (columns + rows / cuda::kTmaCluster) * 128, true});
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

}  // namespace

ProductCut cut_for_hopper(MatrixKind kind, std::int64_t n_row, std::int64_t n_column, std::int64_t depth,
                          HopperCutFor what, int n_sm, const CudaWays& ways) {
  const bool is_bf16 = kind == MatrixKind::bf16;
  const std::int64_t n_step = ceil_div(depth, is_bf16 ? cuda::kHopperDepth : cuda::kHopperInt8Depth);
  const ProductRates& rates = is_bf16 ? kBf16 : kind == MatrixKind::int8 ? kInt8 : kTernary;
  ProductCut best = {.shape = cuda::Bf16Shape::rows128, .us = std::numeric_limits<double>::max()};
  for (const Candidate& tile : candidates(kind, what))
    for (const auto& [n_split, in_cluster] : cuda::kHopperSplits) {
      // The measured range: a share has at least 4 steps, or for codes 1 step with up to 4 shares. Products of codes
      // are not split further than about twice the SMs can use.
      const std::int64_t n_whole = ceil_div(n_row, tile.rows) * ceil_div(n_column, tile.columns);
      if (n_split > 1 && n_step / n_split < (is_bf16 || n_split > 4 ? 4 : 1)) break;
      if (!is_bf16 && n_whole * (n_split - 1) > 2 * n_sm) break;
      const bool has_adder = n_split > 1 && !in_cluster;
      if (has_adder && (what == HopperCutFor::begins_norm || (!ways.adders && n_row <= 64))) continue;
      if (in_cluster && !ways.clusters) continue;
      const bool is_for_tma = n_split == 1 && n_row > 64 && what != HopperCutFor::several;
      if (tile.by_tma && !(ways.tma && is_for_tma)) continue;
      const auto size = static_cast<double>(tile.columns * tile.rows);
      const std::int64_t n_of_y = what == HopperCutFor::gated ? tile.columns / 2 : tile.columns;
      const auto n_used = static_cast<double>(std::min(tile.rows, n_row));
      const double n_finished = static_cast<double>(n_of_y) * n_used / n_split;
      const double of_step =
          std::max({size / rates.sums, static_cast<double>(tile.step_bytes) / rates.of_sm, rates.least});
      double of_block = rates.block + static_cast<double>(ceil_div(n_step, n_split)) * of_step;
      if (n_split == 1 || in_cluster)
        of_block += rates.first_end + rates.end * n_finished;
      else
        of_block += rates.share * size;
      if (in_cluster) of_block += combine_us(static_cast<double>(tile.columns) * n_used, n_split);
      const int n_usable = in_cluster ? usable_sms(n_sm, n_split) : n_sm;
      const auto n_wave = static_cast<double>(ceil_div(n_whole * n_split, n_usable));
      double us = rates.kernel + of_block * (1 + rates.further * (n_wave - 1));
      if (has_adder) us += static_cast<double>(4 * n_row * n_column * (n_split + 1)) / kWritten;
      if (us < best.us)
        best.n_split = n_split, best.tile = tile.index, best.in_cluster = in_cluster, best.us = us,
        best.by_tma = tile.by_tma;
    }
  return best;
}

}  // namespace vla::lower

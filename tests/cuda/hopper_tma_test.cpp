// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/kernels/hopper_tma.h"

#include <algorithm>

#include "cuda/gated_product.h"

namespace hopper_tma_test {

using namespace vla;
using namespace vla::cuda;
using namespace vla::test::cuda;

namespace {

// For tiles of 128 columns and 192 or 256 rows: less than a tile and more, a block of a cluster without columns, rows
// that the other block fetches alone, a depth of one step, of as many as there are stages, and of several turns of
// them, which 64 and 8 divide, and do not.
constexpr ProductCase kCases[] = {
    {41, 256, 70, 1, Activation::none, true, false, false, true},
    {193, 40, 132, 1, Activation::relu, false, true, true},
    {260, 320, 260, 1, Activation::silu, true, true, true, true, true},
    {100, 1080, 66, 1, Activation::none, true, false, false, true, false, true},
    {67, 301, 70, 1, Activation::gelu_erf, true, false, false, true},
    {30, 840, 384, 1, Activation::gelu_tanh, true, true, false, true, true},
};

/// The tile of hopper_linear_bf16 of the same shape.
const HopperTile& tile_of(const HopperTmaTile& tile) {
  return *std::find_if(std::begin(kHopperTiles), std::end(kHopperTiles), [&](const HopperTile& one) {
    return one.columns == tile.columns && one.rows == tile.rows && one.is_gated == tile.is_gated;
  });
}

void launch_tma(const HopperTmaTile& tile, const LinearBf16Job& product) {
  HopperTmaJob job = {.product = product};
  job.x = map_rows(mapped_x(tile, product)), job.weight = map_rows(mapped_weight(tile, product, product.weight));
  if (tile.is_gated) job.gate_weight = map_rows(mapped_weight(tile, product, product.gate_weight));
  launch(hopper_tma_bf16(tile, product), job);
}

}  // namespace

TEST_CASE("products whose operands TMA fetches are as near to doubles, and those of the other tiles, to the bit") {
  if (!is_hopper()) {
    MESSAGE("skipped: no device of compute capability 9.0");
    return;
  }
  counts = {};
  for (const ProductCase& c : kCases) {
    for (const HopperTmaTile& tile : kHopperTmaTiles) {
      INFO(tile.kernel, ", ", c.n_row, " x ", c.depth, " x ", c.n_column);
      const GatedProduct product(c, tile.is_gated);
      const std::vector<float> other =
          product.run([&](const LinearBf16Job& job) { launch(hopper_linear_bf16(tile_of(tile), job), job); });
      in_two_schedules(static_cast<std::size_t>((&c - kCases) + (&tile - kHopperTmaTiles)), [&] {
        const std::vector<float> y = product.run([&](const LinearBf16Job& job) { launch_tma(tile, job); });
        CHECK(error(y, product.expected()) < product.most());
        CHECK(y == other);
      });
    }
  }
  CHECK(counts.bank_conflicts == 0);
}

TEST_CASE("products whose operands TMA fetches end a norm as the other tiles do, to the bit") {
  if (!is_hopper()) {
    MESSAGE("skipped: no device of compute capability 9.0");
    return;
  }
  constexpr int kRows = 200, kDepth = 128, kColumns = 72, kParts = 2;
  Numbers numbers;
  const Device<std::uint16_t> x(bf16_rows(numbers.floats(kRows * kDepth), kDepth, kDepth));
  const Device<std::uint16_t> weight(bf16_rows(numbers.floats(kColumns * kDepth), kDepth, kDepth));
  std::vector<float> squares = numbers.floats(kRows * kParts);
  for (float& one : squares) one *= one;
  const Device<float> sums(squares);
  for (const HopperTmaTile& tile : kHopperTmaTiles) {
    if (tile.is_gated) continue;
    const Device<float> y(kRows * kColumns), other(kRows * kColumns);
    LinearBf16Job job = {.x = x.get(), .weight = weight.get(), .x_stride = kDepth, .weight_stride = kDepth};
    job.n_row = kRows, job.n_column = kColumns, job.depth = kDepth, job.n_split = 1;
    job.norm_end = {{sums.get(), nullptr, kParts, 64}, 1e-3f}, job.end.y_stride = kColumns, job.end.y = other.get();
    launch(hopper_linear_bf16(tile_of(tile), job), job);
    job.end.y = y.get();
    launch_tma(tile, job);
    CHECK(y.host() == other.host());
  }
}

}  // namespace hopper_tma_test

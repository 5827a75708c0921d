// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <deque>

#include "cuda/gated_product.h"

namespace hopper_linear_test {

using namespace vla;
using namespace vla::cuda;
using namespace vla::test::cuda;

namespace {

// For tiles of up to 192 columns and 256 rows: less than a tile, and more; a depth of more steps than there are stages;
// splits of one step and of more; columns that four at a time divide, and do not; blocks of a cluster without rows.
constexpr ProductCase kHopperCases[] = {
    {41, 256, 70, 4, Activation::none, true, false, false, true},
    {20, 520, 132, 8, Activation::relu, false, true, true},
    {5, 40, 33, 1, Activation::relu, true},
    {260, 72, 200, 1, Activation::silu, true, true, true, true, true},
    {65, 616, 66, 1, Activation::none, true, false, false, true, false, true},
    {67, 301, 70, 3, Activation::gelu_erf, true, false, false, true},
    {96, 136, 136, 3, Activation::gelu_tanh, true, false, false, true, true},
    {129, 192, 200, 1},
    {70, 140, 72, 2, Activation::none, true, true, true, true, false, true},
};

}  // namespace

TEST_CASE("bf16 products in tiles for Hopper are as near to doubles, and shares are added in order, to the bit") {
  if (!is_hopper()) {
    MESSAGE("skipped: no device of compute capability 9.0");
    return;
  }
  counts = {};
  for (const ProductCase& c : kHopperCases) {
    for (const HopperTile& tile : kHopperTiles) {
      INFO(tile.kernel, ", ", c.n_row, " x ", c.depth, " x ", c.n_column);
      const GatedProduct product(c, tile.is_gated);
      const std::vector<double> expected = product.expected();
      const auto run = [&](float* shares) {
        return product.run([&](LinearBf16Job& job) {
          job.partial = shares;
          launch(hopper_linear_bf16(tile, job), job);
          if (shares != nullptr) launch(finish_bf16_partial(job), job);
        });
      };
      std::vector<float> by_kernel;  // y whose shares another kernel adds
      if (c.n_split > 1) {
        const Device<float> partial(static_cast<std::size_t>(2 * c.n_split * c.n_row * c.n_column));
        schedule = {7, false};
        by_kernel = run(partial.get());
        CHECK(error(by_kernel, expected) < product.most());
      }
      // Activations that round once are the same in every kernel.
      const bool is_exact = c.activation == Activation::none || c.activation == Activation::relu;
      in_two_schedules(static_cast<std::size_t>((&c - kHopperCases) + (&tile - kHopperTiles)), [&] {
        const std::vector<float> y = run(nullptr);
        CHECK(error(y, expected) < product.most());
        if (c.n_split > 1 && is_exact) CHECK(y == by_kernel);
      });
    }
  }
  CHECK(counts.bank_conflicts == 0);
}

TEST_CASE("several products in tiles for Hopper are what each is alone, to the bit") {
  if (!is_hopper()) {
    MESSAGE("skipped: no device of compute capability 9.0");
    return;
  }
  for (const HopperTile& tile : kHopperTiles)
    for (const int n_split : {1, 3}) {
      if (tile.several == nullptr) continue;
      INFO(tile.several, ", ", n_split, " shares");
      constexpr int kRows = 70, kDepth = 200, kColumns[] = {130, 64, 200};
      Numbers numbers;
      const Device<std::uint16_t> x(bf16_rows(numbers.floats(kRows * kDepth), kDepth, kDepth));
      std::deque<Device<std::uint16_t>> weights;
      std::deque<Device<float>> together, alone;
      Several<LinearBf16Job> jobs = {};
      for (const int n_column : kColumns) {
        weights.emplace_back(bf16_rows(numbers.floats(n_column * kDepth), kDepth, kDepth));
        for (auto* all : {&together, &alone}) all->emplace_back(static_cast<std::size_t>(kRows * n_column));
        LinearBf16Job& job = jobs.job[jobs.n++];
        job = {.x = x.get(), .weight = weights.back().get(), .x_stride = kDepth, .weight_stride = kDepth};
        job.n_row = kRows, job.n_column = n_column, job.depth = kDepth, job.n_split = n_split;
        job.end.y = alone.back().get(), job.end.y_stride = n_column;
        launch(hopper_linear_bf16(tile, job), job);
        job.end.y = together.back().get();
      }
      in_every_schedule([&] {
        const Launch product = hopper_linears_bf16(tile, jobs);
        launch(product, jobs);
        for (std::size_t i = 0; i < alone.size(); ++i) CHECK(together[i].host() == alone[i].host());
      });
    }
}

}  // namespace hopper_linear_test

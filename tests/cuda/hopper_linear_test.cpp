// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <deque>

#include "cuda/kernels/linear_bf16.h"
#include "cuda/products.h"

namespace hopper_linear_test {

using namespace vla;
using namespace vla::cuda;
using namespace vla::test::cuda;

namespace {

// For tiles of up to 192 columns and 256 rows: less than a tile, and more; a depth of more steps than there are stages;
// splits of one step and of more; columns that four at a time divide, and do not; blocks of a cluster without rows.
constexpr ProductCase kHopperCases[] = {
    {41, 380, 70, 6, Activation::none, true, false, false, true},
    {20, 520, 132, 8, Activation::relu, false, true, true},
    {5, 40, 33, 1, Activation::relu, true},
    {260, 72, 200, 1, Activation::silu, true, true, true, true, true},
    {65, 616, 66, 1, Activation::none, true, false, false, true, false, true},
    {67, 301, 70, 3, Activation::gelu_erf, true, false, false, true},
    {96, 136, 136, 3, Activation::gelu_tanh, true, false, false, true, true},
    {129, 192, 200, 1},
    {70, 140, 136, 2, Activation::relu, true, true, false, true, true},
    {130, 260, 72, 4, Activation::none, true, true, true, true, false, true},
};

/// y of a product whose shares of the depth are products of their own and are added by the kernel that adds those of
/// other GPUs' tiles. `tile` is not gated.
void run_shares(const HopperTile& tile, LinearBf16Job job) {
  const Device<float> partial(static_cast<std::size_t>(job.n_split * job.n_row * job.n_sum()));
  const int n_step = (job.depth + kHopperDepth - 1) / kHopperDepth;
  for (int z = 0; z < job.n_split; ++z) {
    const int first = n_step * z / job.n_split * kHopperDepth, end = n_step * (z + 1) / job.n_split * kHopperDepth;
    LinearBf16Job share = job;
    share.x = static_cast<const std::uint16_t*>(job.x) + first;
    share.depth = std::min(end, job.depth) - first, share.n_split = 1;
    share.gate_weight = nullptr, share.gate_bias = nullptr, share.end = {};
    share.end.y_stride = job.n_sum();
    for (const auto* weight : {job.gate_weight, job.weight}) {
      if (weight == nullptr) continue;
      share.weight = weight + first;
      share.end.y =
          partial.get() + z * job.n_row * job.n_sum() + (weight == job.weight ? job.n_sum() - job.n_column : 0);
      launch(hopper_linear_bf16(tile, share), share);
    }
  }
  job.partial = partial.get();
  launch(finish_bf16_partial(job), job);
}
const HopperTile& plain(const HopperTile& tile) {
  return *std::find_if(std::begin(kHopperTiles), std::end(kHopperTiles), [&](const HopperTile& other) {
    return !other.is_gated && other.columns == tile.columns && other.rows == tile.rows;
  });
}

}  // namespace

TEST_CASE("bf16 products in tiles for Hopper are as near to doubles, and shares are added in order, to the bit") {
  if (!is_hopper()) {
    MESSAGE("skipped: no device of compute capability 9.0");
    return;
  }
  counts = {};
  for (const ProductCase& c : kHopperCases) {
    const std::int64_t stride = round_up(c.depth, 8) + 8;
    for (const HopperTile& tile : kHopperTiles) {
      Operands of(c, true);
      // What the gate's product is, is the gate of what is expected.
      Operands gate({c.n_row, c.depth, c.n_column, 1, Activation::none, c.has_bias}, true);
      if (tile.is_gated) {
        std::reverse_copy(of.weight.begin(), of.weight.end(), gate.weight.begin());
        const std::vector<double> made = gate.expected();
        std::copy(made.begin(), made.end(), of.gate.begin()), of.c.has_gate = true;
      }
      const std::vector<double> expected = of.expected();
      INFO(tile.kernel, ", ", c.n_row, " x ", c.depth, " x ", c.n_column);
      const auto run = [&](auto multiply) {
        return run_product(of, [&](Epilogue end) {
          if (tile.is_gated) end.gate = nullptr;
          const Device<float> bias(gate.bias);
          const Device<std::uint16_t> gate_weight(bf16_rows(gate.weight, c.depth, stride));
          const Device<std::uint16_t> x(bf16_rows(of.x, c.depth, stride)),
              weight(bf16_rows(of.weight, c.depth, stride));
          LinearBf16Job job = {x.get(),    weight.get(), stride,    stride,  c.n_row,
                               c.n_column, c.depth,      c.n_split, nullptr, end};
          if (tile.is_gated) job.gate_weight = gate_weight.get(), job.gate_bias = c.has_bias ? bias.get() : nullptr;
          multiply(job);
        });
      };
      // Activations that round once are the same in every kernel.
      const bool is_exact = c.activation == Activation::none || c.activation == Activation::relu;
      std::vector<float> by_shares;
      if (c.n_split > 1 && is_exact) by_shares = run([&](const LinearBf16Job& job) { run_shares(plain(tile), job); });
      in_every_schedule([&] {
        const std::vector<float> y = run([&](const LinearBf16Job& job) { launch(hopper_linear_bf16(tile, job), job); });
        if (!by_shares.empty()) CHECK(y == by_shares);
        CHECK(error(y, expected) < (c.is_bf16 ? 4e-3 : (tile.is_gated ? 2 : 1) * (1e-6 + bf16_sum_error(c.depth))));
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

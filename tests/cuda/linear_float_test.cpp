// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <memory>

#include "cuda/kernels/linear_bf16.h"
#include "cuda/kernels/linear_f32.h"
#include "cuda/products.h"

namespace linear_float_test {

using namespace vla;
using namespace vla::cuda;
using namespace vla::test::cuda;

namespace {

// Fewer than a tile, and a little more; depths that end within a step and within 16 bytes; every activation and each
// part of the epilogue.
constexpr ProductCase kCases[] = {
    {1, 8, 32, 1},
    {7, 40, 33, 1, Activation::relu, true},
    {50, 200, 144, 1, Activation::gelu_tanh, true, false, false, true},
    {129, 72, 130, 1, Activation::silu, true, true, true, true, true},
    {67, 301, 70, 3, Activation::gelu_erf, true, false, false, true},
    {16, 1000, 35, 4, Activation::relu_squared, false, true},
    {50, 720, 70, 1, Activation::none, false, false, false, true, true},
    {48, 296, 20, 3, Activation::silu, true, false, true},
    {65, 48, 66, 1, Activation::none, true, false, false, true, false, true},
};

}  // namespace

TEST_CASE(
    "bf16 products of every shape are as near to doubles as sums in float32, or a rounding of y, are; few rows are not "
    "rounded") {
  counts = {};
  for (const ProductCase& c : kCases) {
    for (Bf16Shape shape : {Bf16Shape::few, Bf16Shape::strip16, Bf16Shape::strip32, Bf16Shape::strip64,
                            Bf16Shape::strip128, Bf16Shape::rows64, Bf16Shape::rows128}) {
      if (strip_width(shape) > 0 && c.depth % 8 != 0) continue;
      INFO("shape ", static_cast<int>(shape), ", ", c.n_row, " x ", c.depth, " x ", c.n_column);
      const bool is_few = shape == Bf16Shape::few;
      const Operands of(c, !is_few);
      const std::vector<double> expected = of.expected();
      const std::int64_t stride = round_up(c.depth, 8) + 8;
      in_every_schedule([&] {
        const std::vector<float> y = run_product(of, [&](const Epilogue& end) {
          const Device<float> few(of.x), partial(static_cast<std::size_t>(c.n_split * c.n_row * c.n_column));
          const Device<std::uint16_t> rounded(bf16_rows(of.x, c.depth, stride)),
              weight(bf16_rows(of.weight, c.depth, stride));
          const LinearBf16Job job = {is_few ? static_cast<const void*>(few.get()) : rounded.get(),
                                     weight.get(),
                                     is_few ? c.depth : stride,
                                     stride,
                                     c.n_row,
                                     c.n_column,
                                     c.depth,
                                     c.n_split,
                                     partial.get(),
                                     end};
          launch(linear_bf16(shape, job), job);
          if (c.n_split > 1) launch(finish_bf16_partial(job), job);
        });
        CHECK(error(y, expected) < (c.is_bf16 ? 4e-3 : 1e-6 + (is_few ? 0 : bf16_sum_error(c.depth))));
      });
    }
  }
  CHECK(counts.bank_conflicts == 0);
}

namespace {

struct StripProduct {
  int n_column;
  bool rotates;
};
constexpr int kHead = 32;  // of products that rotate

/// Checks that one launch of strips stores what a launch for each product does.
void check_several_strips(std::initializer_list<StripProduct> products) {
  constexpr int kRows = 50, kDepth = 200;
  Numbers numbers;
  const std::int64_t stride = round_up(kDepth, 8);
  const Device<std::uint16_t> x(bf16_rows(numbers.floats(kRows * kDepth), kDepth, stride));
  const Device<float> table(numbers.floats(kHead * kRows)), bias(numbers.floats(128));
  for (unsigned width : {16U, 32U, 64U}) {
    std::vector<std::unique_ptr<Device<std::uint16_t>>> weights;
    std::vector<std::unique_ptr<Device<float>>> together, alone;
    Several<LinearBf16Job> jobs = {};
    for (const auto& [n, rotates] : products) {
      const auto size = static_cast<std::size_t>(kRows * n);
      weights.push_back(std::make_unique<Device<std::uint16_t>>(bf16_rows(numbers.floats(n * kDepth), kDepth, stride)));
      together.push_back(std::make_unique<Device<float>>(size)), alone.push_back(std::make_unique<Device<float>>(size));
      Epilogue end = {};
      end.bias = bias.get(), end.y = alone.back()->get(), end.y_stride = n;
      LinearBf16Job job = {x.get(), weights.back()->get(), stride, stride, kRows, n, kDepth, 1, nullptr, end};
      if (rotates) job.rotation = {table.get(), kHead, kRows};
      launch(linear_strip(width, job), job);
      job.end.y = together.back()->get();
      jobs.job[jobs.n++] = job;
    }
    launch(linear_strips(width, jobs), jobs);
    for (std::size_t i = 0; i < alone.size(); ++i) CHECK(together[i]->host() == alone[i]->host());
  }
}

}  // namespace

TEST_CASE("several products in one launch of strips are those of launches of their own") {
  check_several_strips({{70, false}, {33, false}, {128, false}});
}

TEST_CASE("strips multiply by a gate's matrix too") {
  counts = {};
  for (ProductCase c : {ProductCase{50, 720, 70, 1, Activation::silu, true, true, false, true, true},
                        ProductCase{48, 296, 21, 3, Activation::gelu_tanh, true},
                        ProductCase{9, 64, 130, 2, Activation::none, false, false, false, true}}) {
    const std::int64_t stride = round_up(c.depth, 8) + 8;
    Numbers numbers;
    // What the gate's product is, is the gate of what is expected.
    Operands gate(ProductCase{c.n_row, c.depth, c.n_column, 1, Activation::none, c.has_bias}, true);
    gate.weight = rounded_to_bf16(numbers.floats(c.n_column * c.depth, 0.1f));
    c.has_gate = true;
    Operands of(c, true);
    gate.x = of.x;
    const std::vector<double> made = gate.expected();
    std::copy(made.begin(), made.end(), of.gate.begin());
    const std::vector<double> expected = of.expected();
    for (Bf16Shape shape : {Bf16Shape::strip16, Bf16Shape::strip32, Bf16Shape::strip64, Bf16Shape::strip128}) {
      INFO("shape ", static_cast<int>(shape), ", ", c.n_row, " x ", c.depth, " x ", c.n_column);
      in_every_schedule([&] {
        const std::vector<float> y = run_product(of, [&](Epilogue end) {
          end.gate = nullptr;
          const Device<float> partial(static_cast<std::size_t>(2 * c.n_split * c.n_row * c.n_column)), bias(gate.bias);
          const Device<std::uint16_t> x(bf16_rows(of.x, c.depth, stride)),
              weight(bf16_rows(of.weight, c.depth, stride)), gate_weight(bf16_rows(gate.weight, c.depth, stride));
          LinearBf16Job job = {x.get(), weight.get(), stride,        stride, c.n_row, c.n_column,
                               c.depth, c.n_split,    partial.get(), end,    {},      {}};
          job.gate_weight = gate_weight.get(), job.gate_bias = c.has_bias ? bias.get() : nullptr;
          launch(linear_bf16(shape, job), job);
          if (c.n_split > 1) launch(finish_bf16_partial(job), job);
        });
        CHECK(error(y, expected) < (c.is_bf16 ? 4e-3 : 2e-6 + 2 * bf16_sum_error(c.depth)));
      });
    }
  }
  CHECK(counts.bank_conflicts == 0);
}

namespace {

/// Rotates the heads of a product's rows by a table [d_head, n_token]; rows are tokens of one batch after the other.
std::vector<double> rotated(const std::vector<double>& y, int n_column, int d_head, int n_token,
                            const std::vector<float>& table) {
  std::vector<double> turned(y.size());
  const int half = d_head / 2, n_row = static_cast<int>(y.size()) / n_column;
  for (int row = 0; row < n_row; ++row)
    for (int column = 0; column < n_column; ++column) {
      const int i = column % d_head % half;
      const auto at = static_cast<std::size_t>(row * n_column + column),
                 place = static_cast<std::size_t>(row % n_token * d_head + i);
      const bool is_first = column % d_head < half;
      const double other = is_first ? -y[at + static_cast<std::size_t>(half)] : y[at - static_cast<std::size_t>(half)];
      const auto cosine = static_cast<double>(table[place]), sine = static_cast<double>(table[place + d_head / 2]);
      turned[at] = y[at] * cosine + other * sine;
    }
  return turned;
}

struct RotatedCase {
  ProductCase product;
  int d_head, n_token;
};
// Heads narrower and wider than a strip's half, and widths that are no powers of two; several batches; shares.
constexpr RotatedCase kRotated[] = {
    {{50, 720, 192, 1, Activation::none, false, false, false, false, true}, 64, 50},
    {{48, 104, 72, 1, Activation::none, true}, 24, 16},
    {{10, 64, 16, 1, Activation::none, true, false, false, false, true}, 8, 5},
    {{65, 296, 256, 1}, 256, 65},
    {{48, 296, 80, 3, Activation::none, true}, 40, 24},
    {{9, 512, 1280, 2, Activation::none, false, false, false, false, true}, 256, 3},
};

}  // namespace

TEST_CASE("products in strips, and kernels that add shares, rotate heads") {
  counts = {};
  for (const auto& [c, d_head, n_token] : kRotated) {
    const Operands of(c, true);
    Numbers numbers;
    const std::vector<float> table = numbers.floats(d_head * n_token);
    const std::vector<double> expected = rotated(of.expected(), c.n_column, d_head, n_token, table);
    const std::int64_t stride = round_up(c.depth, 8);
    for (Bf16Shape shape : {Bf16Shape::strip16, Bf16Shape::strip32, Bf16Shape::strip64, Bf16Shape::rows64}) {
      if (shape == Bf16Shape::rows64 && c.n_split == 1) continue;
      for (const std::size_t to_align : {0, 1}) {  // floats
        if (to_align > 0 && shape != Bf16Shape::strip16) continue;
        INFO("shape ", static_cast<int>(shape), ", ", c.n_row, " x ", c.depth, " x ", c.n_column, ", off ", to_align);
        in_every_schedule([&] {
          const std::vector<float> y = run_product(of, [&](const Epilogue& end) {
            std::vector<float> placed(to_align, NAN);
            placed.insert(placed.end(), table.begin(), table.end());
            const Device<float> partial(static_cast<std::size_t>(c.n_split * c.n_row * c.n_column)), turns(placed);
            const Device<std::uint16_t> x(bf16_rows(of.x, c.depth, stride)),
                weight(bf16_rows(of.weight, c.depth, stride));
            const LinearBf16Job job = {.x = x.get(),
                                       .weight = weight.get(),
                                       .x_stride = stride,
                                       .weight_stride = stride,
                                       .n_row = c.n_row,
                                       .n_column = c.n_column,
                                       .depth = c.depth,
                                       .n_split = c.n_split,
                                       .partial = partial.get(),
                                       .end = end,
                                       .rotation = {turns.get() + to_align, d_head, n_token}};
            launch(linear_bf16(shape, job), job);
            if (c.n_split > 1) launch(finish_bf16_partial(job), job);
          });
          CHECK(error(y, expected) < (c.is_bf16 ? 4e-3 : 2e-6 + 2 * bf16_sum_error(c.depth)));
        });
      }
    }
  }
  CHECK(counts.bank_conflicts == 0);
}

TEST_CASE("a launch of several strips rotates some of its products, as launches of their own do") {
  check_several_strips({{128, true}, {36, false}, {64, true}});
}

TEST_CASE("one launch adds the shares of several products, and rotates some, as launches of their own do") {
  constexpr int kRows = 20, kSplits = 3;
  struct Product {
    int n_column, d_head;  // d_head 0: not rotated
  };
  constexpr Product kProducts[] = {{1100, 0}, {1280, 80}, {33, 0}};
  Numbers numbers;
  const Device<float> bias(numbers.floats(1280)), table(numbers.floats(80 * kRows));
  std::vector<std::unique_ptr<Device<float>>> shares, together, alone;
  Several<LinearBf16Job> jobs = {};
  for (const auto& [n_column, d_head] : kProducts) {
    const auto size = static_cast<std::size_t>(kRows * n_column);
    shares.push_back(std::make_unique<Device<float>>(numbers.floats(kSplits * kRows * n_column)));
    together.push_back(std::make_unique<Device<float>>(size)), alone.push_back(std::make_unique<Device<float>>(size));
    LinearBf16Job& job = jobs.job[jobs.n++];
    job = {.n_row = kRows, .n_column = n_column, .n_split = kSplits, .partial = shares.back()->get()};
    job.end.bias = bias.get(), job.end.y = alone.back()->get(), job.end.y_stride = n_column;
    if (d_head > 0) job.rotation = {table.get(), d_head, kRows};
    launch(finish_bf16_partial(job), job);
    job.end.y = together.back()->get();
  }
  in_every_schedule([&] {
    const Launch how = finish_bf16_partials(jobs);
    launch(how, jobs);
    for (std::size_t i = 0; i < alone.size(); ++i) {
      CHECK(together[i]->host() == alone[i]->host());
      CHECK(!std::isnan(together[i]->host().back()));
    }
  });
}

TEST_CASE("float32 products are within 2e-6 of doubles") {
  for (const ProductCase& c : kCases) {
    const Operands of(c, false);
    INFO(c.n_row, " x ", c.depth, " x ", c.n_column);
    in_every_schedule([&] {
      const std::vector<float> y = run_product(of, [&](const Epilogue& end) {
        const Device<float> x(of.x), weight(of.weight);
        const LinearF32Job job = {x.get(), weight.get(), c.depth, c.n_row, c.n_column, c.depth, end};
        launch(linear_f32(job), job);
      });
      CHECK(error(y, of.expected()) < (c.is_bf16 ? 4e-3 : 2e-6));
    });
  }
}

}  // namespace linear_float_test

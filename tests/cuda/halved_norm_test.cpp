// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <functional>

#include "cuda/kernels/linear_bf16.h"
#include "cuda/products.h"

/// RMS norms that products begin and end.
namespace halved_norm_test {

using namespace vla;
using namespace vla::cuda;
using namespace vla::test::cuda;

namespace {

/// A kernel that begins norms: a strip's width, or 0 for Hopper's tile.
struct Beginner {
  unsigned width;
  int n_split;
};
constexpr Beginner kBeginners[] = {{16, 1}, {32, 1}, {64, 1}, {0, 1}, {0, 3}, {0, 8}};

// Rows and columns that a block has, fewer, and more; columns that four at a time divide, and do not.
constexpr ProductCase kBegun[] = {
    {50, 520, 72, 1, Activation::none, false, false, false, true},
    {64, 520, 128, 1},
    {65, 520, 131, 1, Activation::none, true, true, false, true},
    {9, 520, 20, 1, Activation::none, true},
};

/// Checks that a product leaves y, y * weight in bf16, and the sums of y * y of each part of a row.
void check_begun(const ProductCase& c, const Beginner& kernel, bool has_weight) {
  const Operands of(c, true);
  const std::int64_t stride = round_up(c.depth, 8), of_rows = round_up(c.n_column, 2) + 2;
  const int part = kernel.width == 0 ? 64 : norm_part(kernel.width), n_part = (c.n_column + part - 1) / part;
  Numbers numbers;
  const std::vector<float> weight = numbers.floats(c.n_column);
  const Device<std::uint16_t> rows(std::vector<std::uint16_t>(static_cast<std::size_t>(c.n_row * of_rows), 0xffff));
  const Device<float> norm_weight(weight), squares(static_cast<std::size_t>(n_part * c.n_row));
  const std::vector<float> y = run_product(of, [&](const Epilogue& end) {
    const Device<std::uint16_t> x(bf16_rows(of.x, c.depth, stride)), matrix(bf16_rows(of.weight, c.depth, stride));
    const LinearBf16Job job = {
        .x = x.get(),
        .weight = matrix.get(),
        .x_stride = stride,
        .weight_stride = stride,
        .n_row = c.n_row,
        .n_column = c.n_column,
        .depth = c.depth,
        .n_split = kernel.n_split,
        .partial = nullptr,
        .end = end,
        .norm_begin = {rows.get(), of_rows, has_weight ? norm_weight.get() : nullptr, squares.get()}};
    launch(kernel.width == 0 ? hopper_linear_bf16(kHopperTiles[kHopperBegins], job) : linear_strip(kernel.width, job),
           job);
  });
  CHECK(error(y, of.expected()) < 1e-6 + bf16_sum_error(c.depth));
  const std::vector<float> begun = widened(rows.host()), sums = squares.host();
  std::vector<double> expected(sums.size());
  bool are_rounded = true;
  for (int row = 0; row < c.n_row; ++row)
    for (int i = 0; i < of_rows; ++i) {
      const auto column = static_cast<std::size_t>(i);
      const float found = begun[static_cast<std::size_t>(row * of_rows + i)];
      if (i >= c.n_column) {
        are_rounded = are_rounded && std::isnan(found);  // nothing is written behind a row
        continue;
      }
      const float value = y[static_cast<std::size_t>(row * c.n_column + i)];
      are_rounded = are_rounded && found == from_bf16(to_bf16(has_weight ? value * weight[column] : value));
      expected[static_cast<std::size_t>(i / part * c.n_row + row)] += static_cast<double>(value) * value;
    }
  CHECK(are_rounded);
  CHECK(error(sums, expected) < 1e-6);
}

}  // namespace

TEST_CASE("products begin norms: they leave y, y times a weight in bf16, and sums of squares") {
  counts = {};
  for (const ProductCase& c : kBegun)
    for (const Beginner& kernel : kBeginners) {
      if (kernel.width == 0 && !is_hopper()) continue;
      INFO("width ", kernel.width, ", ", kernel.n_split, " shares, ", c.n_row, " x ", c.n_column);
      in_every_schedule([&] { check_begun(c, kernel, c.n_column != 20); });
    }
  CHECK(counts.bank_conflicts == 0);
}

namespace {

struct EndedCase {
  std::string name;
  int n_split = 1;
  bool has_partial = false, is_gated = false, is_rotated = false;
  std::function<void(const LinearBf16Job&)> run;
};

/// Checks that a product that ends a norm is the product of normed rows, to the bit: factors are powers of two.
void check_ended(const EndedCase& c) {
  constexpr int kRows = 50, kColumns = 96, kDepth = 520, kParts = 9, kHead = 32;
  constexpr float kEps = 0.5f;
  Numbers numbers;
  const std::vector<float> x = rounded_to_bf16(numbers.floats(kRows * kDepth));
  std::vector<float> normed = x, squares(kParts * kRows);
  for (int row = 0; row < kRows; ++row) {
    const int power = row % 5 - 3;
    for (int i = 0; i < kDepth; ++i) normed[static_cast<std::size_t>(row * kDepth + i)] *= std::ldexp(1.0f, power);
    const float all = kDepth * (std::ldexp(1.0f, -2 * power) - kEps);
    for (int part = 1; part < kParts; ++part) squares[static_cast<std::size_t>(part * kRows + row)] = all / 16;
    squares[static_cast<std::size_t>(row)] = all / 2;
  }
  const Device<std::uint16_t> as_they_are(bf16_rows(x, kDepth, kDepth)), by_hand(bf16_rows(normed, kDepth, kDepth));
  const Device<std::uint16_t> weight(bf16_rows(numbers.floats(kColumns * kDepth, 0.04f), kDepth, kDepth)),
      gate(bf16_rows(numbers.floats(kColumns * kDepth, 0.04f), kDepth, kDepth));
  const Device<float> sums(squares), bias(numbers.floats(kColumns)), table(numbers.floats(kHead * kRows));
  const Device<float> partial(static_cast<std::size_t>(2 * c.n_split * kRows * kColumns));
  const auto run = [&](const std::uint16_t* rows, const NormEnd& norm) {
    const Device<float> y(static_cast<std::size_t>(kRows * kColumns));
    LinearBf16Job job = {.x = rows, .weight = weight.get(), .x_stride = kDepth, .weight_stride = kDepth};
    job.n_row = kRows, job.n_column = kColumns, job.depth = kDepth, job.n_split = c.n_split;
    job.partial = c.has_partial ? partial.get() : nullptr;
    job.end.bias = bias.get(), job.end.y = y.get(), job.end.y_stride = kColumns;
    if (c.is_gated) job.gate_weight = gate.get(), job.gate_bias = bias.get(), job.end.activation = Activation::silu;
    if (c.is_rotated) job.rotation = {table.get(), kHead, kRows};
    job.norm_end = norm;
    c.run(job);
    return y.host();
  };
  INFO(c.name, ", ", c.n_split, " shares");
  const std::vector<float> expected = run(by_hand.get(), {});
  static std::size_t number = 0;
  in_two_schedules(number++, [&] {
    const std::vector<float> found = run(as_they_are.get(), {sums.get(), kParts, kEps});
    CHECK(found == expected);
    CHECK(!std::isnan(found.back()));
  });
}

/// Runs three products in one launch, `launch_of` them; `job` is the last, the others have results of their own.
template <class LaunchOf>
void run_several(const LinearBf16Job& job, LaunchOf launch_of) {
  const auto n = static_cast<std::size_t>(job.n_row * job.n_column);
  const Device<float> first(n), second(n);
  Several<LinearBf16Job> jobs = {{job, job, job}, {}, 3};
  jobs.job[0].end.y = first.get(), jobs.job[1].end.y = second.get();
  const Launch how = launch_of(jobs);
  launch(how, jobs);
}

}  // namespace

TEST_CASE("strips end norms, to the bit") {
  for (const unsigned width : {16U, 32U, 64U, 128U})
    for (const bool are_several : {false, true}) {
      if (width == 128 && are_several) continue;
      const auto run = [=](const LinearBf16Job& job) {
        if (!are_several) return launch(linear_strip(width, job), job);
        run_several(job, [=](Several<LinearBf16Job>& jobs) { return linear_strips(width, jobs); });
      };
      check_ended({.name = "strips", .run = run});
      if (width < 128) check_ended({.name = "rotated strips", .is_rotated = true, .run = run});
      if (!are_several) check_ended({.name = "gated strips", .is_gated = true, .run = run});
    }
}

TEST_CASE("kernels that add shares end norms, to the bit") {
  const auto run = [](Bf16Shape shape, bool are_several) {
    return [=](const LinearBf16Job& job) {
      launch(linear_bf16(shape, job), job);
      if (!are_several) return launch(finish_bf16_partial(job), job);
      run_several(job, finish_bf16_partials);
    };
  };
  for (const bool are_several : {false, true})
    for (const Bf16Shape shape : {Bf16Shape::strip16, Bf16Shape::rows64, Bf16Shape::rows128}) {
      check_ended({"shares", 3, true, false, false, run(shape, are_several)});
      check_ended({"shares of rotated heads", 3, true, false, true, run(shape, are_several)});
    }
  check_ended({"shares of gated products", 3, true, true, false, run(Bf16Shape::strip32, false)});
  check_ended({"more shares than are added at once", 9, true, false, false, run(Bf16Shape::rows64, false)});
}

TEST_CASE("tiles for Hopper end norms, to the bit") {
  if (!is_hopper()) {
    MESSAGE("skipped: no device of compute capability 9.0");
    return;
  }
  for (const HopperTile& tile : kHopperTiles)
    for (const auto& [n_split, in_cluster] : kHopperSplits) {
      if (n_split != 1 && n_split != 3) continue;
      const auto run = [&](const LinearBf16Job& job) {
        launch(hopper_linear_bf16(tile, job), job);
        if (job.partial != nullptr) launch(finish_bf16_partial(job), job);
      };
      check_ended({tile.kernel, n_split, n_split > 1 && !in_cluster, tile.is_gated, false, run});
      if (tile.several == nullptr || n_split > 1) continue;
      check_ended({.name = tile.several, .run = [&](const LinearBf16Job& job) {
                     run_several(job, [&](Several<LinearBf16Job>& jobs) { return hopper_linears_bf16(tile, jobs); });
                   }});
    }
}

TEST_CASE("a product that ends a norm gives what the norm and the product would") {
  constexpr int kRows = 20, kWidth = 136, kDepth = 64, kColumns = 40, kPart = 16, kParts = (kWidth + kPart - 1) / kPart;
  constexpr float kEps = 1e-2f;
  const Operands first({kRows, kDepth, kWidth, 1}, true);
  Numbers numbers;
  const std::vector<float> weight = numbers.floats(kWidth), matrix = rounded_to_bf16(numbers.floats(kColumns * kWidth));
  const std::vector<double> y = first.expected();
  std::vector<double> expected;
  for (std::size_t row = 0; row < kRows; ++row) {
    double squares = 0;
    for (std::size_t i = 0; i < kWidth; ++i) squares += y[row * kWidth + i] * y[row * kWidth + i];
    const double factor = 1 / std::sqrt(squares / kWidth + static_cast<double>(kEps));
    for (std::size_t column = 0; column < kColumns; ++column) {
      double sum = 0;
      for (std::size_t i = 0; i < kWidth; ++i)
        sum += y[row * kWidth + i] * factor * static_cast<double>(weight[i]) *
               static_cast<double>(matrix[column * kWidth + i]);
      expected.push_back(sum);
    }
  }
  const Device<std::uint16_t> x(bf16_rows(first.x, kDepth, kDepth)), w(bf16_rows(first.weight, kDepth, kDepth)),
      next(bf16_rows(matrix, kWidth, kWidth)), rows(static_cast<std::size_t>(kRows * kWidth));
  const Device<float> of_norm(weight), squares(kParts * kRows), sums(kRows * kWidth), result(kRows * kColumns);
  LinearBf16Job begins = {.x = x.get(), .weight = w.get(), .x_stride = kDepth, .weight_stride = kDepth};
  begins.n_row = kRows, begins.n_column = kWidth, begins.depth = kDepth, begins.n_split = 1;
  begins.end.y = sums.get(), begins.end.y_stride = kWidth;
  begins.norm_begin = {rows.get(), kWidth, of_norm.get(), squares.get()};
  LinearBf16Job ends = {.x = rows.get(), .weight = next.get(), .x_stride = kWidth, .weight_stride = kWidth};
  ends.n_row = kRows, ends.n_column = kColumns, ends.depth = kWidth, ends.n_split = 1;
  ends.end.y = result.get(), ends.end.y_stride = kColumns, ends.norm_end = {squares.get(), kParts, kEps};
  launch(linear_strip(kPart, begins), begins);
  launch(linear_strip(kPart, ends), ends);
  CHECK(error(result.host(), expected) < 6e-3);  // rows are rounded to bf16
}

}  // namespace halved_norm_test

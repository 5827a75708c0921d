// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <functional>

#include "cuda/kernels/linear_bf16.h"
#include "cuda/products.h"

/// RMS norms that products begin and end.
namespace halved_norm_test {

using namespace vla;
using namespace vla::cuda;
using namespace vla::test::cuda;

namespace {

/// A kernel that begins norms: a strip's width, or 0 for a tile of Hopper.
struct Beginner {
  unsigned width;
  int n_split;
  std::size_t tile = 0;  // index into kHopperTiles
};
constexpr Beginner kBeginners[] = {{16, 1}, {32, 1}, {64, 1}, {0, 1}, {0, 3}, {0, 8}, {0, 1, 1}, {0, 4, 1}, {0, 2, 2}};

// Rows and columns that a block has, fewer, and more; columns that four at a time divide, and do not; depths that up to
// eight, four and two blocks of a cluster share.
constexpr ProductCase kBegun[] = {
    {50, 520, 72, 1, Activation::none, false, false, false, true},
    {64, 264, 128, 1},
    {65, 136, 131, 1, Activation::none, true, true, false, true},
    {9, 264, 20, 1, Activation::none, true},
};

struct BegunNorm {
  bool is_layer, has_weight, has_bias;
};

/// Checks that a product leaves y, y * weight in bf16 with the norm's weight and bias after the last row, and the
/// moments of each part of a row.
void check_begun(const ProductCase& c, const Beginner& kernel, const BegunNorm& norm) {
  const Operands of(c, true);
  const std::int64_t stride = round_up(c.depth, 8), of_rows = round_up(c.n_column, 2) + 2;
  const int part = kernel.width == 0 ? 64 : norm_part(kernel.width), n_part = (c.n_column + part - 1) / part;
  const int n_more = (norm.is_layer ? 2 : 0) + (norm.has_bias ? 2 : 0);
  Numbers numbers;
  const std::vector<float> weight = numbers.floats(c.n_column), bias = numbers.floats(c.n_column);
  const Device<std::uint16_t> rows(
      std::vector<std::uint16_t>(static_cast<std::size_t>((c.n_row + n_more) * of_rows), 0xffff));
  const Device<float> norm_weight(weight), norm_bias(bias), squares(static_cast<std::size_t>(n_part * c.n_row)),
      sums(static_cast<std::size_t>(n_part * c.n_row));
  const std::vector<float> y = run_product(of, [&](const Epilogue& end) {
    const Device<std::uint16_t> x(bf16_rows(of.x, c.depth, stride)), matrix(bf16_rows(of.weight, c.depth, stride));
    LinearBf16Job job = {.x = x.get(), .weight = matrix.get(), .x_stride = stride, .weight_stride = stride};
    job.n_row = c.n_row, job.n_column = c.n_column, job.depth = c.depth, job.n_split = kernel.n_split, job.end = end;
    job.norm_begin = {.rows = rows.get(),
                      .stride = of_rows,
                      .weight = norm.has_weight ? norm_weight.get() : nullptr,
                      .bias = norm.has_bias ? norm_bias.get() : nullptr,
                      .moments = {squares.get(), norm.is_layer ? sums.get() : nullptr, n_part, part}};
    launch(kernel.width == 0 ? hopper_linear_bf16(kHopperTiles[kernel.tile], job) : linear_strip(kernel.width, job),
           job);
  });
  CHECK(error(y, of.expected()) < 1e-6 + bf16_sum_error(c.depth));
  const std::vector<float> begun = widened(rows.host());
  // An element of the rows and of those after the last.
  const auto expected_row = [&](int row, std::size_t i) {
    const float scale = norm.has_weight ? weight[i] : 1;
    if (row < c.n_row) return y[static_cast<std::size_t>(row * c.n_column) + i] * scale;
    const float value = norm.is_layer && row < c.n_row + 2 ? scale : bias[i];
    return (row - c.n_row) % 2 == 0 ? value : value - from_bf16(to_bf16(value));
  };
  bool are_rounded = true;
  for (int row = 0; row < c.n_row + n_more; ++row)
    for (int i = 0; i < of_rows; ++i) {
      const float found = begun[static_cast<std::size_t>(row * of_rows + i)];
      const bool is_there = i < c.n_column;  // nothing is written behind a row
      are_rounded =
          are_rounded &&
          (is_there ? found == from_bf16(to_bf16(expected_row(row, static_cast<std::size_t>(i)))) : std::isnan(found));
    }
  CHECK(are_rounded);
  std::vector<double> expected_sums, expected_squares;
  for (int p = 0; p < n_part; ++p)
    for (int row = 0; row < c.n_row; ++row) {
      const int end = std::min((p + 1) * part, c.n_column);
      double sum = 0, off = 0;
      const auto value = [&](int i) { return static_cast<double>(y[static_cast<std::size_t>(row * c.n_column + i)]); };
      for (int i = p * part; i < end; ++i) sum += value(i);
      const double mean = norm.is_layer ? sum / (end - p * part) : 0;
      for (int i = p * part; i < end; ++i) off += (value(i) - mean) * (value(i) - mean);
      expected_sums.push_back(sum), expected_squares.push_back(off);
    }
  CHECK(error(squares.host(), expected_squares) < 1e-6);
  if (norm.is_layer) CHECK(error(sums.host(), expected_sums) < 1e-6);
}

}  // namespace

TEST_CASE("products begin norms: they leave y, y times a weight in bf16, and moments of rows") {
  counts = {};
  for (const ProductCase& c : kBegun)
    for (const Beginner& kernel : kBeginners) {
      if (kernel.width == 0 && (!is_hopper() || kernel.n_split * kHopperDepth > c.depth)) continue;
      INFO("width ", kernel.width, ", tile ", kernel.tile, ", ", kernel.n_split, " shares, ", c.n_row, " x ",
           c.n_column);
      for (const BegunNorm& norm : {BegunNorm{false, c.n_column != 20, false}, BegunNorm{true, c.n_column != 20, true}})
        in_two_schedules(static_cast<std::size_t>(&kernel - kBeginners), [&] { check_begun(c, kernel, norm); });
      check_begun(c, kernel, {true, true, false});
      check_begun(c, kernel, {false, false, true});
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
  constexpr int kRows = 50, kColumns = 96, kDepth = 264, kParts = 9, kHead = 32;
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
    const std::vector<float> found = run(as_they_are.get(), {{sums.get(), nullptr, kParts, 64}, kEps});
    CHECK(found == expected);
    CHECK(!std::isnan(found.back()));
  });
}

/// Checks a product that ends layer norms, and RMS norms with a bias, against doubles.
void check_shifted(const EndedCase& c) {
  constexpr int kRows = 41, kColumns = 96, kDepth = 264, kPart = 64, kParts = (kDepth + kPart - 1) / kPart, kHead = 32;
  constexpr float kEps = 0.25f;
  Numbers numbers;
  const std::vector<float> x =
      rounded_to_bf16(numbers.floats((kRows + 4) * kDepth));  // and a weight's and a bias' rows
  const std::vector<float> squares = numbers.floats(kParts * kRows), sums = numbers.floats(kParts * kRows, 9);
  std::vector<float> positive = squares;
  for (float& one : positive) one = 30 * std::fabs(one) + 1;
  const std::vector<float> weight = rounded_to_bf16(numbers.floats(kColumns * kDepth, 0.04f)),
                           gate = rounded_to_bf16(numbers.floats(kColumns * kDepth, 0.04f)),
                           bias = numbers.floats(kColumns), table = numbers.floats(kHead * kRows);
  const Device<std::uint16_t> rows(bf16_rows(x, kDepth, kDepth)), of_y(bf16_rows(weight, kDepth, kDepth)),
      of_gate(bf16_rows(gate, kDepth, kDepth));
  const Device<float> all_squares(positive), all_sums(sums), all_bias(bias), turns(table),
      partial(static_cast<std::size_t>(2 * c.n_split * (kRows + 4) * kColumns));
  const auto product = [&](const std::vector<float>& matrix, int row, int column) {
    double sum = 0;
    for (int k = 0; k < kDepth; ++k)
      sum += static_cast<double>(x[static_cast<std::size_t>(row * kDepth + k)]) *
             static_cast<double>(matrix[static_cast<std::size_t>(column * kDepth + k)]);
    return sum;
  };
  for (const bool is_layer : {true, false}) {
    const auto normed = [&](const std::vector<float>& matrix, int row, int column) {
      double mean = 0, all = 0;
      const auto at = [&](int part) { return static_cast<std::size_t>(part * kRows + row); };
      for (int part = 0; part < kParts && is_layer; ++part) mean += static_cast<double>(sums[at(part)]) / kDepth;
      for (int part = 0; part < kParts; ++part) {
        const int n = std::min(kPart, kDepth - part * kPart);
        const double off = is_layer ? static_cast<double>(sums[at(part)]) / n - mean : 0;
        all += static_cast<double>(positive[at(part)]) + n * off * off;
      }
      const double factor = 1 / std::sqrt(all / kDepth + static_cast<double>(kEps));
      const auto both = [&](int first) { return product(matrix, first, column) + product(matrix, first + 1, column); };
      return factor * (product(matrix, row, column) - mean * both(kRows)) + both(is_layer ? kRows + 2 : kRows) +
             static_cast<double>(bias[static_cast<std::size_t>(column)]);
    };
    std::vector<double> expected;
    for (int row = 0; row < kRows; ++row)
      for (int column = 0; column < kColumns; ++column) {
        double y = normed(weight, row, column);
        if (c.is_gated) y *= activated(Activation::silu, normed(gate, row, column));
        if (c.is_rotated) {
          const int half = kHead / 2, i = column % half;
          const bool is_first = column % kHead < half;
          const double other = is_first ? -normed(weight, row, column + half) : normed(weight, row, column - half);
          y = y * static_cast<double>(table[static_cast<std::size_t>(row * kHead + i)]) +
              other * static_cast<double>(table[static_cast<std::size_t>(row * kHead + half + i)]);
        }
        expected.push_back(y);
      }
    INFO(c.name, ", ", c.n_split, " shares, layer norm: ", is_layer);
    const Device<float> y(static_cast<std::size_t>(kRows * kColumns));
    LinearBf16Job job = {.x = rows.get(), .weight = of_y.get(), .x_stride = kDepth, .weight_stride = kDepth};
    job.n_row = kRows, job.n_column = kColumns, job.depth = kDepth, job.n_split = c.n_split;
    job.partial = c.has_partial ? partial.get() : nullptr;
    job.end.bias = all_bias.get(), job.end.y = y.get(), job.end.y_stride = kColumns;
    if (c.is_gated)
      job.gate_weight = of_gate.get(), job.gate_bias = all_bias.get(), job.end.activation = Activation::silu;
    if (c.is_rotated) job.rotation = {turns.get(), kHead, kRows};
    job.norm_end = {{all_squares.get(), is_layer ? all_sums.get() : nullptr, kParts, kPart}, kEps, true};
    c.run(job);
    CHECK(error(y.host(), expected) < 4e-6 + 4 * bf16_sum_error(kDepth));
  }
}
void check_both(const EndedCase& c) { check_ended(c), check_shifted(c); }

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

TEST_CASE("strips end norms, RMS norms to the bit") {
  for (const unsigned width : {16U, 32U, 64U, 128U})
    for (const bool are_several : {false, true}) {
      if (width == 128 && are_several) continue;
      const auto run = [=](const LinearBf16Job& job) {
        if (!are_several) return launch(linear_strip(width, job), job);
        run_several(job, [=](Several<LinearBf16Job>& jobs) { return linear_strips(width, jobs); });
      };
      check_both({.name = "strips", .run = run});
      if (width < 128) check_both({.name = "rotated strips", .is_rotated = true, .run = run});
      if (!are_several) check_both({.name = "gated strips", .is_gated = true, .run = run});
    }
}

TEST_CASE("kernels that add shares end norms, RMS norms to the bit") {
  const auto run = [](Bf16Shape shape, bool are_several) {
    return [=](const LinearBf16Job& job) {
      launch(linear_bf16(shape, job), job);
      if (!are_several) return launch(finish_bf16_partial(job), job);
      run_several(job, finish_bf16_partials);
    };
  };
  for (const bool are_several : {false, true})
    for (const Bf16Shape shape : {Bf16Shape::strip16, Bf16Shape::rows64, Bf16Shape::rows128})
      for (const bool is_rotated : {false, true}) {
        const EndedCase one = {"shares", 3, true, false, is_rotated, run(shape, are_several)};
        shape == Bf16Shape::strip16 ? check_both(one) : check_ended(one);
      }
  check_both({"shares of gated products", 3, true, true, false, run(Bf16Shape::strip32, false)});
  check_ended({"more shares than are added at once", 9, true, false, false, run(Bf16Shape::rows64, false)});
}

TEST_CASE("tiles for Hopper end norms, RMS norms to the bit") {
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
      check_both({tile.kernel, n_split, n_split > 1 && !in_cluster, tile.is_gated, false, run});
      if (tile.several == nullptr || n_split > 1) continue;
      check_both({.name = tile.several, .run = [&](const LinearBf16Job& job) {
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
  begins.norm_begin = {rows.get(), kWidth, of_norm.get(), nullptr, {squares.get(), nullptr, kParts, kPart}};
  LinearBf16Job ends = {.x = rows.get(), .weight = next.get(), .x_stride = kWidth, .weight_stride = kWidth};
  ends.n_row = kRows, ends.n_column = kColumns, ends.depth = kWidth, ends.n_split = 1;
  ends.end.y = result.get(), ends.end.y_stride = kColumns,
  ends.norm_end = {{squares.get(), nullptr, kParts, kPart}, kEps};
  launch(linear_strip(kPart, begins), begins);
  launch(linear_strip(kPart, ends), ends);
  CHECK(error(result.host(), expected) < 6e-3);  // rows are rounded to bf16
}

}  // namespace halved_norm_test

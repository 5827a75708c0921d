// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/kernels/rows.h"

#include <doctest/doctest.h>

#include <set>
#include <string>

#include "cuda/kernels/map.h"
#include "cuda/machine.h"
#include "cuda/numbers.h"
#include "kernels/portable/vec_portable.h"
#include "kernels/quantized.h"

namespace rows_test {

using namespace vla;
using namespace vla::cuda;
using namespace vla::test::cuda;

namespace {

double wide(float x) { return static_cast<double>(x); }

/// x + residual, normed, of every row.
std::vector<double> normed(const std::vector<float>& x, const std::vector<float>& weight,
                           const std::vector<float>& bias, const NormJob& job) {
  std::vector<double> y;
  const auto n = static_cast<std::size_t>(job.n);
  for (std::size_t first = 0; first < x.size(); first += n) {
    double mean = 0, squares = 0;
    for (std::size_t i = 0; i < n; ++i) mean += wide(x[first + i]) / job.n;
    if (job.norm != RowNorm::layer) mean = 0;
    for (std::size_t i = 0; i < n; ++i) squares += (wide(x[first + i]) - mean) * (wide(x[first + i]) - mean) / job.n;
    const double factor = job.norm == RowNorm::none ? 1 : 1 / std::sqrt(squares + wide(job.eps));
    for (std::size_t i = 0; i < n; ++i)
      y.push_back((wide(x[first + i]) - mean) * factor * (job.weight ? wide(weight[i]) : 1) +
                  (job.bias ? wide(bias[i]) : 0));
  }
  return y;
}

/// Rows as the CPU's kernels make codes of them.
std::vector<std::byte> quantized(const std::vector<float>& x, std::int64_t n) {
  const std::int64_t stride = kernels::quantized_stride(n), n_row = static_cast<std::int64_t>(x.size()) / n;
  std::vector<std::byte> rows(static_cast<std::size_t>(kernels::quantized_size(n_row, n)));
  for (std::int64_t r = 0; r < n_row; ++r)
    kernels::quantize_row<kernels::Portable>(&x[static_cast<std::size_t>(r * n)], n,
                                             &rows[static_cast<std::size_t>(r * stride)]);
  rows.resize(static_cast<std::size_t>(n_row * stride));
  return rows;
}

}  // namespace

TEST_CASE("norms of a sum are within 2e-6 of doubles, and the sum is what was added") {
  const std::set<std::string> kernels = {"norm_rows", "norm_rows_2", "norm_rows_4", "norm_rows_8", "norm_many_rows"};
  std::set<std::string> seen;
  const auto check = [&](RowNorm kind, int n, int n_row, int stride) {
    INFO("norm ", static_cast<int>(kind), " of ", n_row, " x ", n, ", stride ", stride);
    Numbers numbers;
    const std::vector<float> x = numbers.floats(n_row * stride), residual = numbers.floats(n_row * n);
    const std::vector<float> weight = numbers.floats(n), bias = numbers.floats(n);
    std::vector<float> both;
    for (int i = 0; i < n_row * n; ++i)
      both.push_back(x[static_cast<std::size_t>(i / n * stride + i % n)] + residual[static_cast<std::size_t>(i)]);
    const Device<float> gx(x), gresidual(residual), gweight(weight), gbias(bias), sum(both.size()), y(both.size());
    const Device<std::uint16_t> half(both.size());
    NormJob job = {gx.get(), gresidual.get(), sum.get(), gweight.get(), gbias.get(), y.get(),     stride,
                   n,        n_row,           n,         1e-6f,         kind,        RowType::f32};
    seen.insert(norm_rows(job).kernel);
    in_every_schedule([&] {
      launch(norm_rows(job), job);
      CHECK(sum.host() == both);
      CHECK(error(y.host(), normed(both, weight, bias, job)) < 2e-6);
    });
    job.y = half.get(), job.type = RowType::bf16, job.bias = nullptr;
    launch(norm_rows(job), job);
    CHECK(widened(half.host()) != y.host());
    CHECK(error(widened(half.host()), normed(both, weight, bias, job)) < 4e-3);
  };
  for (RowNorm kind : {RowNorm::layer, RowNorm::rms, RowNorm::none}) {
    for (int n : {2, 31, 256, 1000, 2560, 6912,
                  kind == RowNorm::layer ? kMaxKept
                  : kind == RowNorm::rms ? kMaxKept + 1
                                         : 3})
      for (int behind : {5, 8}) check(kind, n, 3, n + behind);
    check(kind, 36, kManyRows + 2, 40);
  }
  check(RowNorm::layer, kOfWarp, kManyRows, kOfWarp);
  CHECK(seen == kernels);
}

TEST_CASE("a norm adds the shares of a product as the kernel that does nothing else") {
  for (const int n : {720, 1024, 2048})
    for (const int n_split : {2, kMostSplits})
      for (const bool has_all : {false, true}) {
        INFO(n, " columns, ", n_split, " shares");
        Numbers numbers;
        const int n_row = 5;
        const Device<float> partial(numbers.floats(n * n_row * n_split)), residual(numbers.floats(n * n_row));
        const Device<float> bias(numbers.floats(n)), factor(numbers.floats(n)), weight(numbers.floats(n));
        const Device<float> v(static_cast<std::size_t>(n * n_row)), y(static_cast<std::size_t>(n * n_row));
        FinishNormJob job = {};
        job.product = {.n_row = n_row, .n_column = n, .n_split = n_split, .partial = partial.get()};
        Epilogue& end = job.product.end;
        end.y = v.get(), end.y_stride = n;
        if (has_all) end.bias = bias.get(), end.factor = factor.get(), end.residual = residual.get();
        job.norm = {.sum = v.get(), .weight = has_all ? weight.get() : nullptr, .y = y.get(), .y_stride = n};
        job.norm.n_row = n_row, job.norm.n = n, job.norm.eps = 1e-6f, job.norm.norm = RowNorm::rms;
        launch(finish_bf16_partial(job.product), job.product);
        const std::vector<float> sums = v.host();
        const std::vector<double> expected = normed(sums, weight.host(), {}, job.norm);
        in_every_schedule([&] {
          CHECK(is_whole(job));
          launch(finish_norm_rows(job), job);
          CHECK(v.host() == sums);
          CHECK(error(y.host(), expected) < 2e-6);
        });
      }
}

TEST_CASE("codes of rows are the CPU's to the bit") {
  for (int n : {1, 63, 64, 300, 1000, 2560, 6912, kMaxKept + 3}) {
    INFO(n);
    Numbers numbers;
    std::vector<float> x = numbers.floats(6 * n);
    const auto row = [&](int r) { return x.begin() + r * n; };
    std::fill(row(0), row(1), 0.0f);
    for (int i = 0; i < n; ++i)
      row(1)[i] *= 3e-6f, row(2)[i] = static_cast<float>(i % 255) / 2 - 63;  // halves, with 127
    row(2)[n / 2] = -127, row(3)[n - 1] = 3e38f, row(4)[n / 3] = INFINITY, row(5)[0] = NAN;
    const std::vector<std::byte> expected = quantized(x, n);
    const Device<float> gx(x);
    in_every_schedule([&] {
      const Device<std::byte> y(expected.size());
      const NormJob job = {
          gx.get(), nullptr, nullptr, nullptr,       nullptr,       y.get(), n, kernels::quantized_stride(n),
          6,        n,       0,       RowNorm::none, RowType::codes};
      launch(norm_rows(job), job);
      CHECK(y.host() == expected);
    });
  }
}

TEST_CASE("a normed row's codes are those of the normed row") {
  Numbers numbers;
  const int n = 200;
  const std::vector<float> x = numbers.floats(4 * n), weight = numbers.floats(n);
  const Device<float> gx(x), gweight(weight), y(x.size());
  NormJob job = {gx.get(), nullptr, nullptr, gweight.get(), nullptr,      y.get(),     n,
                 n,        4,       n,       1e-5f,         RowNorm::rms, RowType::f32};
  launch(norm_rows(job), job);
  const std::vector<std::byte> expected = quantized(y.host(), n);
  const Device<std::byte> codes(expected.size());
  job.y = codes.get(), job.y_stride = kernels::quantized_stride(n), job.type = RowType::codes;
  launch(norm_rows(job), job);
  CHECK(codes.host() == expected);
}

TEST_CASE("heads are normed and turned, into rows of another order") {
  for (bool has_weight : {false, true})
    for (bool has_table : {false, true})
      for (int d : {2, 64, 72}) {
        Numbers numbers;
        const int n_head = 3, n_token = 5, n_batch = 2, half = d / 2, padded = d + 8;
        const std::vector<float> x = numbers.floats(d * n_head * n_token * n_batch), weight = numbers.floats(d);
        std::vector<float> table = numbers.floats(d * n_token);
        std::vector<double> expected(static_cast<std::size_t>(n_head * n_token * n_batch * padded));
        for (int row = 0; row < n_head * n_token * n_batch; ++row) {
          const int head = row % n_head, token = row / n_head % n_token, batch = row / n_head / n_token;
          const float* from = &x[static_cast<std::size_t>(row * d)];
          double squares = 0;
          for (int i = 0; i < d; ++i) squares += wide(from[i]) * wide(from[i]) / d;
          const auto value = [&](int i) {
            return has_weight ? wide(from[i]) / std::sqrt(squares + 1e-6) * wide(weight[static_cast<std::size_t>(i)])
                              : wide(from[i]);
          };
          double* to = &expected[static_cast<std::size_t>(((batch * n_head + head) * n_token + token) * padded)];
          for (int i = 0; i < half; ++i) {
            const double cosine = has_table ? wide(table[static_cast<std::size_t>(token * d + i)]) : 1;
            const double sine = has_table ? wide(table[static_cast<std::size_t>(token * d + half + i)]) : 0;
            to[i] = value(i) * cosine - value(i + half) * sine,
            to[i + half] = value(i + half) * cosine + value(i) * sine;
          }
        }
        const Device<float> gx(x), gweight(weight), gtable(table);
        const auto check = [&](void* y, bool is_bf16, double tolerance, auto host) {
          const HeadJob job = {gx.get(),
                               y,
                               has_weight ? gweight.get() : nullptr,
                               has_table ? gtable.get() : nullptr,
                               d,
                               d * n_head,
                               d * n_head * n_token,
                               n_token * padded,
                               padded,
                               n_head * n_token * padded,
                               d,
                               n_head,
                               n_token,
                               n_batch,
                               1e-6f,
                               is_bf16};
          launch(head_rows(job), job);
          const Device<float> first(expected.size()), third(expected.size());  // and beside others in one launch
          Several<HeadJob> jobs = {{job, job, job}, {}, 3};
          jobs.job[0].y = first.get(), jobs.job[0].n_batch = 1, jobs.job[2].y = third.get();
          launch(several_head_rows(jobs), jobs);
          std::vector<float> found = host();
          for (std::size_t i = 0; i < found.size(); ++i)  // what pads a row is left as it is
            if (static_cast<int>(i) % padded >= d) {
              CHECK(std::isnan(found[i]));
              found[i] = 0;
            }
          CHECK(error(found, expected) < tolerance);
        };
        const Device<float> y(expected.size());
        const Device<std::uint16_t> rounded(expected.size());
        in_every_schedule([&] { check(y.get(), false, 2e-6, [&] { return y.host(); }); });
        check(rounded.get(), true, 4e-3, [&] { return widened(rounded.host()); });
      }
}

TEST_CASE("rows are looked up in tables of every type, and an id outside is NaN") {
  const std::vector<std::int32_t> ids = {2, 0, 3, -1, 1};
  const int n = 1300, n_table = 3;  // more than a block looks up
  Numbers numbers;
  const std::vector<float> table = rounded_to_bf16(numbers.floats(n * n_table));
  const Device<float> whole(table), y(ids.size() * static_cast<std::size_t>(n));
  const Device<std::uint16_t> half(bf16_rows(table, n, n)), f16(std::vector<std::uint16_t>(table.size(), 0x3555));
  const Device<std::int32_t> gids(ids);
  for (TableType type : {TableType::f32, TableType::bf16, TableType::f16}) {
    const void* data = type == TableType::f32    ? static_cast<void*>(whole.get())
                       : type == TableType::bf16 ? half.get()
                                                 : f16.get();
    const LookupJob job = {data, gids.get(), y.get(), static_cast<int>(ids.size()), n_table, n, type};
    launch(lookup_rows(job), job);
    const std::vector<float> found = y.host();
    for (std::size_t i = 0; i < found.size(); ++i) {
      const int id = ids[i / static_cast<std::size_t>(n)];
      if (id < 0 || id >= n_table)
        REQUIRE(std::isnan(found[i]));
      else
        REQUIRE(found[i] == (type == TableType::f16
                                 ? 0x1.554p-2f
                                 : table[static_cast<std::size_t>(id * n) + i % static_cast<std::size_t>(n)]));
    }
  }
}

TEST_CASE("elements are added, multiplied and copied with repeated dimensions, in any order") {
  Numbers numbers;
  const int w = 50, h = 7, c = 3;  // more than a block has
  const std::vector<float> a = numbers.floats(w * h * c), b = numbers.floats(h);
  const Device<float> ga(a), gb(b), y(a.size());
  const Device<std::uint16_t> half(a.size());
  for (MapOperation operation : {MapOperation::copy, MapOperation::add, MapOperation::multiply})
    for (Activation activation :
         {Activation::none, Activation::silu, Activation::gelu_erf, Activation::relu_squared, Activation::mish}) {
      // a as [w, h, c]; b has h only; y as [c, w, h].
      MapJob job = {ga.get(),      gb.get(), y.get(),   {w, h, c, 1, 1, 1}, {1, w, w * h}, {0, 1, 0},
                    {c, c * w, 1}, 0.5f,     operation, activation,         false};
      std::vector<double> expected(a.size());
      for (int i = 0; i < w * h * c; ++i) {
        const int x = i % w, row = i / w % h, channel = i / w / h;
        double value = wide(a[static_cast<std::size_t>(i)]);
        if (operation == MapOperation::add) value += wide(b[static_cast<std::size_t>(row)]);
        if (operation == MapOperation::multiply) value *= wide(b[static_cast<std::size_t>(row)]);
        expected[static_cast<std::size_t>((row * w + x) * c + channel)] = activated(activation, value) / 2;
      }
      launch(map_elements(job), job);
      CHECK(error(y.host(), expected) < 1e-6);
      job.y = half.get(), job.is_bf16 = true;
      launch(map_elements(job), job);
      CHECK(error(widened(half.host()), expected) < 4e-3);
    }
}

TEST_CASE("patches of images are rows of channel, row and column") {
  const int size = 4, columns = 3, lines = 2, n_view = 2, width = size * columns, height = size * lines;
  std::vector<float> pixels;
  for (int i = 0; i < width * height * 3 * n_view; ++i) pixels.push_back(static_cast<float>(i));
  const Device<float> x(pixels), y(pixels.size());
  const MapJob job = {
      x.get(),
      nullptr,
      y.get(),
      {size, size, 3, columns, lines, n_view},
      {1, width, width * height, size, size * width, width * height * 3},
      {},
      {1, size, size * size, 3 * size * size, 3 * size * size * columns, 3 * size * size * columns * lines},
      1,
      MapOperation::copy,
      Activation::none,
      false};
  launch(map_elements(job), job);
  std::vector<float> expected;
  for (int view = 0; view < n_view; ++view)
    for (int patch = 0; patch < columns * lines; ++patch)
      for (int i = 0; i < 3 * size * size; ++i) {
        const int column = i % size, row = i / size % size, channel = i / size / size;
        expected.push_back(pixels[static_cast<std::size_t>(
            ((view * 3 + channel) * height + patch / columns * size + row) * width + patch % columns * size + column)]);
      }
  CHECK(y.host() == expected);
  const Device<float> in_parts(pixels.size());
  MapJobs parts = {};
  for (int view = 0; view < n_view; ++view) {
    MapJob& part = parts.job[parts.n++] = job;
    part.size[5] = 1, part.a += view * width * height * 3, part.y = in_parts.get() + view * width * height * 3;
  }
  const Launch how = map_parts(parts);
  launch(how, parts);
  CHECK(in_parts.host() == expected);
}

}  // namespace rows_test

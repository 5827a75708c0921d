// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Products of int8 codes and of weights that are ternary, int4 or int8: every kernel of this machine against whole
// numbers and single roundings, bit for bit.
#include <doctest/doctest.h>

#include <cmath>
#include <cstring>
#include <limits>

#include "base/bf16.h"
#include "base/npy.h"
#include "kernels/int8_kernels.h"
#include "kernels/quantized.h"
#include "support/editable_bundle.h"
#include "support/kernel_rows.h"
#include "support/product.h"
#include "support/stored.h"
#include "support/unwatched.h"

namespace int8_test {

using namespace vla;
using namespace vla::kernels;

namespace {

using Shape = test::ProductShape;
using test::Numbers;

// One row, few, more than a block of rows; depths beyond a step and between its multiples; columns that no panel
// divides; the widths of BitVLA's tower.
constexpr Shape kShapes[] = {{1, 4, 1},      {1, 64, 16},    {2, 12, 31},   {3, 4304, 33}, {32, 260, 65},
                             {33, 260, 65},  {34, 1152, 64}, {65, 68, 129}, {97, 272, 40}, {241, 4304, 70},
                             {300, 100, 17}, {513, 516, 9},  {640, 64, 1}};

/// Rows that quantizing may get wrong: zeros; numbers below the smallest scale; halves between codes; one large number.
std::vector<float> difficult_rows(Numbers& numbers, std::int64_t n_row, std::int64_t d_in) {
  std::vector<float> x = numbers.floats(n_row * d_in);
  for (std::int64_t r = 0; r < n_row; ++r) {
    float* row = &x[static_cast<std::size_t>(r * d_in)];
    for (std::int64_t k = 0; k < d_in; ++k) {
      if (r % 7 == 1) row[k] = 0;
      if (r % 7 == 2) row[k] *= 3e-6f;
      if (r % 7 == 3) row[k] = static_cast<float>(numbers.below(255)) / 2 - 63;  // with 127: whole codes and halves
      if (r % 7 == 3 && k == d_in / 2) row[k] = -127;
      if (r % 7 == 4 && k == 0) row[k] = 3e38f;
    }
  }
  return x;
}

struct Codes {
  std::vector<int> q;
  float s = 0;
  int sum = 0;
};

/// The definition, a rounding at a time.
Codes codes_of(const float* x, std::int64_t n) {
  float a = 1e-5f;
  for (std::int64_t k = 0; k < n; ++k) a = std::max(a, std::abs(x[k]));
  Codes codes = {{}, 1.0f / a * 127.0f, 0};
  for (std::int64_t k = 0; k < n; ++k) {
    volatile float product = x[k] * codes.s;  // volatile: rounded before anything else
    codes.q.push_back(std::min(127, std::max(-128, static_cast<int>(std::nearbyint(product)))));
    codes.sum += codes.q.back();
  }
  return codes;
}

std::span<const LinearKernel* const> kernels_of(DType weights) {
  return weights == DType::ternary ? ternary_kernels() : weights == DType::int4 ? int4_kernels() : int8_kernels();
}

/// Whose packed matrix all kernels read.
DType weights_of(const LinearKernel& kernel) {
  for (const DType weights : {DType::ternary, DType::int4})
    if (kernel.pack == kernels_of(weights).back()->pack) return weights;
  return DType::i8;
}

/// A matrix as it is stored, and its numbers.
struct Matrix {
  std::vector<float> numbers;
  std::vector<std::byte> stored;
};

Matrix random_matrix(Numbers& numbers, DType weights, std::int64_t d_in, std::int64_t d_out) {
  Matrix matrix = {std::vector<float>(static_cast<std::size_t>(d_in * d_out)), {}};
  if (weights == DType::int4) {
    const std::int64_t n_block = Int4Block::n_of(d_in);
    std::vector<int> codes(matrix.numbers.size()), steps(static_cast<std::size_t>(n_block * d_out));
    for (int& step : steps) step = static_cast<int>(numbers.below(Int4Block::kMaxStep + 1));
    for (std::size_t i = 0; i < codes.size(); ++i) {
      const std::int64_t row = static_cast<std::int64_t>(i) / d_in, k = static_cast<std::int64_t>(i) % d_in;
      codes[i] = static_cast<int>(numbers.below(15)) - 7;
      matrix.numbers[i] =
          static_cast<float>(codes[i] * steps[static_cast<std::size_t>(row * n_block + k / Int4Block::kElements)]);
    }
    matrix.stored = test::store_int4(codes, d_in, steps);
    return matrix;
  }
  const bool ternary = weights == DType::ternary;
  for (float& number : matrix.numbers)
    number = ternary ? static_cast<float>(numbers.below(3)) - 1 : static_cast<float>(numbers.below(256)) - 128;
  matrix.stored = ternary ? test::store_ternary(matrix.numbers) : test::store_int8(matrix.numbers);
  return matrix;
}

/// All of its numbers are one: the smallest or the largest that there are.
Matrix extreme_matrix(DType weights, bool largest, std::int64_t d_in, std::int64_t d_out) {
  const auto n = static_cast<std::size_t>(d_in * d_out);
  const float number = (largest ? 1 : -1) * (weights == DType::ternary ? 1.0f : weights == DType::int4 ? 119 : 127);
  Matrix matrix = {std::vector<float>(n, weights == DType::i8 && !largest ? -128 : number), {}};
  if (weights == DType::ternary) matrix.stored = test::store_ternary(matrix.numbers);
  if (weights == DType::i8) matrix.stored = test::store_int8(matrix.numbers);
  if (weights == DType::int4)
    matrix.stored = test::store_int4(std::vector<int>(n, largest ? 7 : -7), d_in,
                                     std::vector<int>(static_cast<std::size_t>(Int4Block::n_of(d_in) * d_out), 17));
  return matrix;
}

VLA_UNWATCHED int sum_of_products(const int* codes, const float* weights, std::int64_t n) {
  int sum = 0;
  for (std::int64_t k = 0; k < n; ++k) sum += codes[k] * static_cast<int>(weights[k]);
  return sum;
}

struct Case {
  Shape shape;
  int n_part = 1;
  bool gated = false, with_bias = false, with_residual = false;
  int n_thread = 1;
  bool rounded = false;  // y, as the kernel lays it out
};

class Trial {
 public:
  Trial(const LinearKernel& kernel, const Case& c) : kernel_(kernel), weights_(weights_of(kernel)), case_(c) {
    const auto [n_row, d_in, unused] = case_.shape;
    x_ = difficult_rows(numbers_, n_row, d_in);
    for (std::int64_t r = 0; r < n_row; ++r) codes_.push_back(codes_of(&x_[static_cast<std::size_t>(r * d_in)], d_in));
    for (int i = 0; i < c.n_part; ++i) parts_.push_back(make_part(d_out(i)));
  }

  void run() {
    const auto [n_row, d_in, unused] = case_.shape;
    const std::int64_t stride = quantized_stride(d_in);
    std::vector<std::byte> rows(static_cast<std::size_t>(quantized_size(n_row, d_in)), std::byte{0xff});
    for (std::int64_t r = 0; r < n_row; ++r)
      kernel_.quantize(&x_[static_cast<std::size_t>(r * d_in)], d_in, rows.data() + r * stride);
    LinearJob job = {};
    job.x = rows.data(), job.x_type = DType::i8, job.x_stride = stride;
    job.n_row = n_row, job.d_in = d_in, job.n_part = case_.n_part, job.gated = case_.gated;
    for (int i = 0; i < case_.n_part; ++i) {
      Part& part = parts_[static_cast<std::size_t>(i)];
      job.part[i] = {DType::i8,
                     part.packed.get(),
                     case_.with_bias ? part.bias.data() : nullptr,
                     nullptr,
                     case_.with_residual ? part.residual.data() : nullptr,
                     reinterpret_cast<std::byte*>(&part.y[1]),
                     d_out(i),
                     part.scale.data()};
      if (!case_.rounded) continue;
      part.rounded.resize(static_cast<std::size_t>(rounded_count(kernel_.rounded, n_row, d_out(i))));
      job.part[i].y = reinterpret_cast<std::byte*>(part.rounded.data()), job.part[i].y_type = DType::bf16;
    }
    test::run_job(kernel_, job, case_.n_thread);
    for (Part& part : parts_)
      if (case_.rounded) widen(part, static_cast<std::int64_t>(part.y.size() - 2) / n_row);
  }

  void check() const {
    for (int i = case_.gated ? 1 : 0; i < case_.n_part; ++i) {
      const auto is_right = [&](std::int64_t row, std::int64_t n, float y) {
        const float exact = expected(i, row, n);
        if (std::isnan(exact)) return std::isnan(y);  // a gate beyond all floats by a product that is zero
        return y == (case_.rounded ? from_bf16(to_bf16(exact)) : exact);
      };
      test::check_rows(parts_[static_cast<std::size_t>(i)].y, case_.shape.n_row, d_out(i), is_right);
    }
  }

 private:
  struct Part {
    std::vector<float> weight, bias, residual, y, scale;  // one scale, or one for each column
    std::vector<std::uint16_t> rounded;
    test::Pages packed = {nullptr, std::free};
  };

  void widen(Part& part, std::int64_t d) {
    for (std::int64_t i = 0; i < case_.shape.n_row * d; ++i) {
      const std::int64_t place = rounded_place(kernel_.rounded, i / d, i % d, d);
      part.y[static_cast<std::size_t>(i + 1)] = from_bf16(part.rounded[static_cast<std::size_t>(place)]);
    }
  }

  std::int64_t d_out(int i) const { return case_.shape.d_out + (case_.gated ? 0 : 7 * i); }

  Part make_part(std::int64_t width) {
    Part part;
    const Matrix matrix = random_matrix(numbers_, weights_, case_.shape.d_in, width);
    part.weight = matrix.numbers;
    part.bias = numbers_.floats(width);
    part.residual = numbers_.floats(case_.shape.n_row * width);
    part.y.assign(static_cast<std::size_t>(case_.shape.n_row * width) + 2, test::kUntouched);
    part.scale = numbers_.floats(weights_ == DType::ternary ? 1 : width);
    part.packed =
        test::packed(*kernels_of(weights_).front(), {weights_, case_.shape.d_in, width}, matrix.stored.data());
    return part;
  }

  float product(int i, std::int64_t row, std::int64_t n) const {
    const Part& part = parts_[static_cast<std::size_t>(i)];
    const Codes& codes = codes_[static_cast<std::size_t>(row)];
    const int sum =
        sum_of_products(codes.q.data(), &part.weight[static_cast<std::size_t>(n * case_.shape.d_in)], case_.shape.d_in);
    const float scale = part.scale[weights_ == DType::ternary ? 0 : static_cast<std::size_t>(n)];
    volatile float y = static_cast<float>(sum) * (scale / codes.s);
    if (case_.with_bias) y = y + part.bias[static_cast<std::size_t>(n)];
    return y;
  }

  float expected(int i, std::int64_t row, std::int64_t n) const {
    volatile float y = product(i, row, n);
    if (case_.gated) y = y * product(0, row, n);
    if (case_.with_residual)
      y = y + parts_[static_cast<std::size_t>(i)].residual[static_cast<std::size_t>(row * d_out(i) + n)];
    return y;
  }

  const LinearKernel& kernel_;
  DType weights_;
  Case case_;
  Numbers numbers_;
  std::vector<float> x_;
  std::vector<Codes> codes_;
  std::vector<Part> parts_;
};

void check(const LinearKernel& kernel, const Case& c) {
  CAPTURE(c.shape.n_row);
  CAPTURE(c.shape.d_in);
  CAPTURE(c.shape.d_out);
  CAPTURE(c.n_thread);
  Trial trial(kernel, c);
  trial.run();
  trial.check();
}

void check_codes(const LinearKernel& kernel) {
  Numbers numbers;
  for (const std::int64_t d_in : {1, 4, 15, 16, 63, 64, 65, 272, 4304}) {
    const std::int64_t n_row = 200;
    const std::vector<float> x = difficult_rows(numbers, n_row, d_in);
    for (std::int64_t r = 0; r < n_row; ++r) {
      const std::int64_t stride = quantized_stride(d_in);
      std::vector<std::byte> row(static_cast<std::size_t>(stride) + 1, std::byte{0xaa});
      const float* numbers_of_row = &x[static_cast<std::size_t>(r * d_in)];
      kernel.quantize(numbers_of_row, d_in, row.data());
      const Codes expected = codes_of(numbers_of_row, d_in);
      const RowScale scale = row_scale(row.data(), d_in);
      int wrong = scale.s != expected.s || scale.sum != expected.sum || row.back() != std::byte{0xaa};
      for (std::int64_t k = 0; k < quantized_depth(d_in); ++k)
        wrong += static_cast<signed char>(row[static_cast<std::size_t>(k)]) !=
                 (k < d_in ? expected.q[static_cast<std::size_t>(k)] : 0);
      CHECK(wrong == 0);
    }
  }
}

void check_not_finite(const LinearKernel& kernel) {
  const DType weights = weights_of(kernel);
  const std::int64_t d_in = 68, d_out = 5;
  const std::vector<float> scale(d_out, 1.0f);
  const Matrix matrix = extreme_matrix(weights, true, d_in, d_out);
  const test::Pages packed = test::packed(kernel, {weights, d_in, d_out}, matrix.stored.data());
  for (const float bad : {std::numeric_limits<float>::infinity(), -std::numeric_limits<float>::quiet_NaN(),
                          std::numeric_limits<float>::quiet_NaN()})
    for (const std::int64_t place : {std::int64_t{0}, std::int64_t{17}, d_in - 1}) {
      std::vector<float> x(static_cast<std::size_t>(d_in), 1.0f), y(static_cast<std::size_t>(d_out));
      x[static_cast<std::size_t>(place)] = bad;
      std::vector<std::byte> row(static_cast<std::size_t>(quantized_size(1, d_in)));
      kernel.quantize(x.data(), d_in, row.data());
      LinearJob job = {};
      job.x = row.data(), job.x_type = DType::i8, job.x_stride = quantized_stride(d_in);
      job.n_row = 1, job.d_in = d_in, job.n_part = 1;
      job.part[0] = {DType::i8, packed.get(), nullptr, nullptr, nullptr, reinterpret_cast<std::byte*>(y.data()),
                     d_out,     scale.data()};
      test::run_job(kernel, job, 1);
      for (const float number : y) CHECK_FALSE(std::isfinite(number));
    }
}

/// tests/kernels/data/ternary.npy, written by tests/reference/make_ternary_data.py.
struct Golden {
  static constexpr std::int64_t kRows = 7, kIn = 272, kOut = 17;
  std::vector<float> x, weight, scale, bias, codes, scales, sums, y;

  Golden() {
    const std::string file = test::read_text(test::source_path("tests/kernels/data/ternary.npy"));
    const auto array = parse_npy(std::as_bytes(std::span(file)), "ternary.npy");
    REQUIRE(array.ok());
    const auto& all = std::get<std::vector<float>>(array->values);
    auto at = all.begin();
    const auto take = [&](std::vector<float>& part, std::int64_t n) { part.assign(at, at + n), at += n; };
    take(x, kRows * kIn), take(weight, kOut * kIn), take(scale, 1), take(bias, kOut);
    take(codes, kRows * kIn), take(scales, kRows), take(sums, kRows * kOut), take(y, kRows * kOut);
    REQUIRE(at == all.end());
  }
};

void check_golden(const LinearKernel& kernel) {
  Golden golden;
  const std::int64_t stride = quantized_stride(Golden::kIn);
  std::vector<std::byte> rows(static_cast<std::size_t>(quantized_size(Golden::kRows, Golden::kIn)));
  for (std::int64_t r = 0; r < Golden::kRows; ++r) {
    std::byte* row = rows.data() + r * stride;
    kernel.quantize(&golden.x[static_cast<std::size_t>(r * Golden::kIn)], Golden::kIn, row);
    CHECK(row_scale(row, Golden::kIn).s == golden.scales[static_cast<std::size_t>(r)]);
    for (std::int64_t k = 0; k < Golden::kIn; ++k)
      CHECK(static_cast<float>(static_cast<signed char>(row[k])) ==
            golden.codes[static_cast<std::size_t>(r * Golden::kIn + k)]);
  }
  const std::vector<std::byte> stored = test::store_ternary(golden.weight);
  const test::Pages packed = test::packed(kernel, {DType::ternary, Golden::kIn, Golden::kOut}, stored.data());
  const auto product = [&](std::int64_t row, std::int64_t n_row, const float* scale, const float* bias) {
    std::vector<float> y(static_cast<std::size_t>(n_row * Golden::kOut));
    LinearJob job = {};
    job.x = rows.data() + row * stride, job.x_type = DType::i8, job.x_stride = stride;
    job.n_row = n_row, job.d_in = Golden::kIn, job.n_part = 1;
    job.part[0] = {DType::i8,    packed.get(), bias, nullptr, nullptr, reinterpret_cast<std::byte*>(y.data()),
                   Golden::kOut, scale};
    test::run_job(kernel, job, 1);
    return y;
  };
  CHECK(product(0, Golden::kRows, golden.scale.data(), golden.bias.data()) == golden.y);
  for (std::int64_t r = 0; r < Golden::kRows; ++r) {  // with the scale of the row itself the sum is left
    const auto first = golden.sums.begin() + r * Golden::kOut;
    CHECK(product(r, 1, &golden.scales[static_cast<std::size_t>(r)], nullptr) ==
          std::vector<float>(first, first + Golden::kOut));
  }
}

/// Codes and weights as large as they get, which overflow 16 bits where pairs of products are summed to them.
void check_extremes(const LinearKernel& kernel) {
  const DType weights = weights_of(kernel);
  const std::int64_t d_in = 4304, d_out = 33, n_row = 40;
  for (const bool largest : {false, true}) {
    const std::vector<float> scale(d_out, 127.0f);
    const Matrix matrix = extreme_matrix(weights, largest, d_in, d_out);
    const test::Pages packed = test::packed(kernel, {weights, d_in, d_out}, matrix.stored.data());
    std::vector<std::byte> rows(static_cast<std::size_t>(quantized_size(n_row, d_in)));
    for (std::int64_t r = 0; r < n_row; ++r) {
      const std::vector<float> x(static_cast<std::size_t>(d_in), r % 2 == 0 ? 1.0f : -1.0f);
      kernel.quantize(x.data(), d_in, rows.data() + r * quantized_stride(d_in));
    }
    std::vector<float> y(static_cast<std::size_t>(n_row * d_out));
    LinearJob job = {};
    job.x = rows.data(), job.x_type = DType::i8, job.x_stride = quantized_stride(d_in);
    job.n_row = n_row, job.d_in = d_in, job.n_part = 1;
    job.part[0] = {DType::i8, packed.get(), nullptr, nullptr, nullptr, reinterpret_cast<std::byte*>(y.data()),
                   d_out,     scale.data()};
    test::run_job(kernel, job, 1);
    for (std::int64_t i = 0; i < n_row * d_out; ++i)
      CHECK(y[static_cast<std::size_t>(i)] ==
            (i / d_out % 2 == 0 ? 127 : -127) * static_cast<float>(d_in) * matrix.numbers[0]);
  }
}

void check_shapes(const LinearKernel& kernel) {
  for (const Shape& shape : kShapes) check(kernel, {.shape = shape});
}

void check_epilogues(const LinearKernel& kernel) {
  for (const Shape& shape : {Shape{1, 64, 16}, Shape{33, 260, 65}, Shape{97, 272, 40}}) {
    for (const bool bias : {false, true})
      for (const bool residual : {false, true})
        check(kernel, {.shape = shape, .with_bias = bias, .with_residual = residual});
    check(kernel, {.shape = shape, .n_part = 2, .gated = true});
    check(kernel, {.shape = shape, .n_part = 2, .gated = true, .with_bias = true, .with_residual = true});
    check(kernel, {.shape = shape, .n_part = 3, .with_bias = true});
    if (kernel.rounded != RoundedLayout::none)
      check(kernel, {.shape = shape, .n_part = 3, .with_bias = true, .rounded = true});
  }
}

/// More columns than sums of which are kept at a time.
void check_wide(const LinearKernel& kernel) {
  check(kernel, {.shape = {41, 260, 1500}});
  check(kernel, {.shape = {41, 260, 900}, .n_part = 2, .gated = true, .with_bias = true});
}

void check_threads(const LinearKernel& kernel) {
  for (const int n_thread : {2, 3, 64})
    for (const Shape& shape : {Shape{1, 64, 16}, Shape{97, 272, 140}, Shape{300, 100, 17}}) {
      check(kernel, {.shape = shape, .with_bias = true, .n_thread = n_thread});
      check(kernel, {.shape = shape, .n_part = 2, .gated = true, .n_thread = n_thread});
    }
}

const LinearKernel* row(std::span<const LinearKernel* const> kernels, const std::string& name) {
  for (const LinearKernel* kernel : kernels)
    if (kernel->name == name) return kernel;
  return nullptr;
}
/// Of ternary weights, of int4 ones and of int8 ones.
void check_all(const std::string& name, void (*check)(const LinearKernel& kernel)) {
  for (const auto& kernels : {ternary_kernels(), int4_kernels(), int8_kernels()}) {
    REQUIRE(row(kernels, name) != nullptr);
    check(*row(kernels, name));
  }
}

/// For doctest's skip decorator: this machine lacks the instructions of a row.
bool lacks(const std::string& name) {
  const LinearKernel* kernel = row(ternary_kernels(), name);
  return kernel == nullptr || !kernel->supports({DType::ternary, 64, 64}, this_cpu());
}

}  // namespace

#define VLA_INT8_TEST_OF(sentence, check, check_named)                                                        \
  TEST_CASE("portable_int8: " sentence) { check_named("portable_int8"); }                                     \
  TEST_CASE("dotprod_int8: " sentence* doctest::skip(lacks("dotprod_int8"))) { check_named("dotprod_int8"); } \
  TEST_CASE("i8mm_int8: " sentence* doctest::skip(lacks("i8mm_int8"))) { check_named("i8mm_int8"); }          \
  TEST_CASE("avx2_int8: " sentence* doctest::skip(lacks("avx2_int8"))) { check_named("avx2_int8"); }          \
  TEST_CASE("avxvnni_int8: " sentence* doctest::skip(lacks("avxvnni_int8"))) { check_named("avxvnni_int8"); } \
  TEST_CASE("avx512_int8: " sentence* doctest::skip(lacks("avx512_int8"))) { check_named("avx512_int8"); }    \
  TEST_CASE("amx_int8: " sentence* doctest::skip(lacks("amx_int8"))) { check_named("amx_int8"); }
#define VLA_LOOKUP_TEST(sentence, check)                                         \
  TEST_CASE("avx512_lookup: " sentence* doctest::skip(lacks("avx512_lookup"))) { \
    check(*row(ternary_kernels(), "avx512_lookup"));                             \
  }
#define VLA_TERNARY_TEST(sentence, check)                                                           \
  VLA_LOOKUP_TEST(sentence, check)                                                                  \
  VLA_INT8_TEST_OF(sentence, check, [](const char* name) { check(*row(ternary_kernels(), name)); }) \
  VLA_EMULATED_TEST("avx512_int8", sentence, check(kEmulatedTernaryAvx512))                         \
  VLA_EMULATED_TEST("amx_int8", sentence, check(kEmulatedTernaryAmx))
#define VLA_INT8_TEST(sentence, check)                                                                  \
  VLA_LOOKUP_TEST(sentence, check)                                                                      \
  VLA_INT8_TEST_OF(sentence, check, [](const char* name) { check_all(name, check); })                   \
  VLA_EMULATED_TEST("avx512_int8", sentence, check(kEmulatedTernaryAvx512); check(kEmulatedInt4Avx512); \
                    check(kEmulatedInt8Avx512))                                                         \
  VLA_EMULATED_TEST("amx_int8", sentence, check(kEmulatedTernaryAmx); check(kEmulatedInt4Amx); check(kEmulatedInt8Amx))

TEST_CASE("few rows go to a kernel that reads the same packed matrix and the same codes") {
  for (const auto& kernels : {ternary_kernels(), int4_kernels(), int8_kernels()})
    for (const LinearKernel* kernel : kernels) {
      const LinearKernel& small_batch = kernel->for_batch(1);
      CHECK((small_batch.pack == kernel->pack));
      CHECK((small_batch.quantize != nullptr));
    }
}

VLA_TERNARY_TEST("codes, sums and products are those of BitVLA's quantizers, bit for bit", check_golden)
VLA_INT8_TEST("codes and scales of rows are the reference's, bit for bit", check_codes)
VLA_INT8_TEST("products of many columns", check_wide)
VLA_INT8_TEST("sums of any shape are exact, and scaled in single roundings", check_shapes)
VLA_INT8_TEST("the largest sums are exact", check_extremes)
VLA_INT8_TEST("bias, gate and residual follow the product, each rounded by itself", check_epilogues)
VLA_INT8_TEST("any number of threads computes every number once, and the same", check_threads)
VLA_INT8_TEST("a row that is not finite has no finite product", check_not_finite)

}  // namespace int8_test

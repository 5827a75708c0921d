// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Every implementation of the matrix product against a sum in double precision, on one list of awkward shapes.
#include <doctest/doctest.h>

#include <cmath>
#include <cstring>
#include <limits>

#include "kernels/cpu_kernels.h"
#include "kernels/linear_kernel.h"
#include "kernels/linear_panels.h"
#include "support/kernel_rows.h"
#include "support/product.h"
#include "support/stored.h"
#include "support/unwatched.h"

namespace linear_test {

using namespace vla;
using namespace vla::kernels;

namespace {

using Shape = test::ProductShape;

// One row, a few, more than a block of rows or of columns; widths that no vector divides; depths beyond one block and
// of one number.
constexpr Shape kShapes[] = {{1, 1, 1},    {1, 33, 17},   {2, 3, 31},     {3, 17, 1},    {5, 31, 33},
                             {6, 16, 16},  {7, 64, 48},   {17, 100, 65},  {50, 72, 205}, {13, 1151, 3},
                             {4, 768, 32}, {33, 40, 70},  {64, 96, 129},  {97, 35, 40},  {300, 33, 530},
                             {270, 5, 9},  {1, 1537, 70}, {7, 760, 1100}, {70, 800, 40}};

constexpr Activation kActivations[] = {Activation::none, Activation::gelu_tanh, Activation::gelu_erf,
                                       Activation::silu, Activation::relu,      Activation::relu_squared,
                                       Activation::mish};

/// Numbers behind one that is skipped, so that the first is at no round address.
struct Numbers : test::Numbers {
  std::vector<float> some(std::int64_t count) { return floats(count + 1); }
};

double activate(Activation activation, double x) {
  if (activation == Activation::silu) return x / (1 + std::exp(-x));
  if (activation == Activation::gelu_tanh)
    return x / (1 + std::exp(-2 * std::sqrt(2 / M_PI) * (x + 0.044715 * x * x * x)));
  if (activation == Activation::gelu_erf) return x / 2 * std::erfc(-x * M_SQRT1_2);
  if (activation == Activation::relu) return std::max(x, 0.0);
  if (activation == Activation::relu_squared) return std::max(x, 0.0) * std::max(x, 0.0);
  if (activation == Activation::mish) return x * std::tanh(std::log1p(std::exp(x)));
  return x;
}

/// One part of a job, with memory of its own.
struct Part {
  std::vector<float> weight, bias, factor, residual, y;
  std::vector<std::byte> stored;
  test::Pages packed = {nullptr, std::free};
};

struct Case {
  Shape shape;
  DType type = DType::bf16;
  Activation activation = Activation::none;
  int n_part = 1;
  bool gated = false, with_bias = false, with_residual = false, with_factor = false;
  int n_thread = 1;
  DType x_type = DType::f32, y_type = DType::f32;
};

bool is_mmla(const LinearKernel& kernel) { return std::strcmp(kernel.name, "neon_bf16") == 0; }
bool rounds(const LinearKernel& kernel) { return kernel.rounded != RoundedLayout::none; }

/// From the second number on.
std::byte* bytes(std::vector<float>& values) { return reinterpret_cast<std::byte*>(&values[1]); }

/// A sum of products, and the sum of their sizes.
struct Sum {
  double value, size;
};
VLA_UNWATCHED Sum add_products(Sum sum, const float* x, const float* w, std::int64_t n) {
  for (std::int64_t k = 0; k < n; ++k) {
    const double term = double{x[k]} * w[k];
    sum.value += term, sum.size += __builtin_fabs(term);
  }
  return sum;
}

class Trial {
 public:
  Trial(const LinearKernel& kernel, const Case& c) : kernel_(kernel), case_(c) {
    x_ = read_ = numbers_.some(c.shape.n_row * c.shape.d_in);
    if (rounds(kernel))
      for (float& value : read_) value = from_bf16(to_bf16(value));
    for (int i = 0; i < c.n_part; ++i) parts_.push_back(make_part(d_out(i)));
  }

  void run() {
    const auto [n_row, d_in, unused] = case_.shape;
    std::vector<std::uint16_t> rounded(
        static_cast<std::size_t>(rounded_count(kernel_.rounded, round_up(n_row, kTileSide), d_in)));
    for (std::int64_t row = 0; row < n_row; ++row)
      for (std::int64_t k = 0; k < d_in; ++k)
        rounded[place(row, k, d_in)] = to_bf16(x_[static_cast<std::size_t>(row * d_in + k + 1)]);
    LinearJob job = {};
    job.x = case_.x_type == DType::bf16 ? reinterpret_cast<const std::byte*>(rounded.data()) : bytes(x_);
    job.x_stride = d_in, job.n_row = n_row, job.d_in = d_in, job.n_part = case_.n_part;
    job.activation = case_.activation, job.gated = case_.gated;
    job.x_type = case_.x_type;
    for (int i = 0; i < case_.n_part; ++i) {
      Part& part = parts_[static_cast<std::size_t>(i)];
      const std::byte* stored = part.stored.data() + number_size(case_.type);  // at no round address
      part.packed = test::packed(kernel_, {case_.type, d_in, d_out(i)}, stored);
      job.part[i] = {case_.type,
                     part.packed.get(),
                     case_.with_bias ? &part.bias[1] : nullptr,
                     case_.with_factor ? &part.factor[1] : nullptr,
                     case_.with_residual ? &part.residual[1] : nullptr,
                     bytes(part.y),
                     d_out(i),
                     nullptr,
                     case_.y_type};
    }
    test::run_job(kernel_, job, case_.n_thread);
  }

  void check() const {
    for (int i = case_.gated ? 1 : 0; i < case_.n_part; ++i) {
      const auto is_right = [&](std::int64_t row, std::int64_t n, float y) {
        const auto [expected, tolerance] = reference(i, row, n);
        return std::abs(y - expected) <= tolerance;
      };
      test::check_rows(y(i), case_.shape.n_row, d_out(i), is_right);
    }
  }

  const std::vector<float>& y(int i) const { return parts_[static_cast<std::size_t>(i)].y; }

  /// Number n of a row of a y that was rounded.
  float rounded_y(std::int64_t row, std::int64_t n) const {
    std::uint16_t bits;
    std::memcpy(&bits, reinterpret_cast<const std::byte*>(&y(0)[1]) + 2 * place(row, n, d_out(0)), sizeof(bits));
    return from_bf16(bits);
  }

 private:
  struct Expected {
    double value, tolerance;
  };

  /// Where element i of a row lies when it is rounded.
  std::size_t place(std::int64_t row, std::int64_t i, std::int64_t d) const {
    return static_cast<std::size_t>(rounded_place(kernel_.rounded, row, i, d));
  }

  /// Parts differ in width, so that items cross from one to the next; a gate and its up do not.
  std::int64_t d_out(int i) const { return case_.shape.d_out + (case_.gated ? 0 : 7 * i); }

  Part make_part(std::int64_t width) {
    Part part;
    part.weight = numbers_.some(case_.shape.d_in * width);
    part.stored = test::store_as(case_.type, part.weight);
    part.bias = numbers_.some(width);
    part.factor = numbers_.some(width);
    part.residual = numbers_.some(case_.shape.n_row * width);
    part.y.assign(static_cast<std::size_t>(case_.shape.n_row * width) + 2, test::kUntouched);
    return part;
  }

  /// W x + b. Every order of n float32 additions of the products is within n half-units of their absolute sum;
  /// BFMMLA's, which do not round to the nearest, within n units.
  Expected product(int i, std::int64_t row, std::int64_t n) const {
    const Part& part = parts_[static_cast<std::size_t>(i)];
    const std::int64_t d_in = case_.shape.d_in;
    const double bias = case_.with_bias ? part.bias[static_cast<std::size_t>(n + 1)] : 0;
    const Sum sum = add_products({bias, std::abs(bias)}, &read_[static_cast<std::size_t>(row * d_in + 1)],
                                 &part.weight[static_cast<std::size_t>(n * d_in + 1)], d_in);
    return {sum.value, static_cast<double>(d_in + 2) * (is_mmla(kernel_) ? 0x1p-23 : 0x1p-24) * sum.size};
  }

  /// The activations are at most 1.13 steep and round twice; what follows rounds once each.
  Expected reference(int i, std::int64_t row, std::int64_t n) const {
    Expected y = product(i, row, n);
    if (case_.gated) {
      const Expected gate = product(0, row, n);
      const double factor = activate(case_.activation, gate.value),
                   slack = 1.13 * gate.tolerance + 0x1p-22 * std::abs(factor);
      y = {y.value * factor, y.tolerance * (std::abs(factor) + slack) + slack * std::abs(y.value)};
    } else {
      y = {activate(case_.activation, y.value), 1.13 * y.tolerance};
    }
    if (case_.with_factor) {
      const double factor = parts_[static_cast<std::size_t>(i)].factor[static_cast<std::size_t>(n + 1)];
      y = {y.value * factor, y.tolerance * std::abs(factor)};
    }
    if (case_.with_residual)
      y.value += parts_[static_cast<std::size_t>(i)].residual[static_cast<std::size_t>(row * d_out(i) + n + 1)];
    return {y.value, y.tolerance + 0x1p-21 * (1 + std::abs(y.value))};
  }

  const LinearKernel& kernel_;
  Case case_;
  Numbers numbers_;
  std::vector<float> x_, read_;  // read_: x as the kernel multiplies it
  std::vector<Part> parts_;
};

void check(const LinearKernel& kernel, const Case& c) {
  // A machine with every instruction of both families.
  constexpr Features all = kernel_set::amx.uses.with(Feature::baseline).with(Feature::neon).with(Feature::neon_bf16);
  if (!kernel.supports({c.type, c.shape.d_in, c.shape.d_out}, all)) return;
  CAPTURE(c.shape.n_row);
  CAPTURE(c.shape.d_in);
  CAPTURE(c.shape.d_out);
  CAPTURE(dtype_name(c.type));
  CAPTURE(c.n_thread);
  Trial trial(kernel, c);
  trial.run();
  trial.check();
}

void check_shapes_and_types(const LinearKernel& kernel) {
  for (const Shape& shape : kShapes)
    for (DType type : {DType::bf16, DType::f16, DType::f32}) check(kernel, {.shape = shape, .type = type});
}

void check_epilogues(const LinearKernel& kernel) {
  for (const Shape& shape : {Shape{1, 33, 17}, Shape{7, 64, 48}, Shape{50, 72, 205}})
    for (Activation activation : kActivations)
      for (int options = 0; options < 8; ++options)
        check(kernel, {.shape = shape,
                       .activation = activation,
                       .with_bias = (options & 1) != 0,
                       .with_residual = (options & 2) != 0,
                       .with_factor = (options & 4) != 0});
}

void check_gates_and_groups(const LinearKernel& kernel) {
  for (const Shape& shape : kShapes) {
    check(kernel, {.shape = shape, .activation = Activation::silu, .n_part = 2, .gated = true});
    check(kernel, {.shape = shape, .activation = Activation::gelu_tanh, .n_part = 2, .gated = true, .with_bias = true});
    check(kernel, {.shape = shape, .activation = Activation::gelu_erf, .n_part = 2, .gated = true});
    check(kernel, {.shape = shape, .n_part = 3, .with_bias = true});
  }
}

/// The depth takes several blocks, of float32 and of bf16, and the panels several items.
void check_depths(const LinearKernel& kernel) {
  Case deep = {.shape = {390, 2080, 33}, .activation = Activation::gelu_tanh, .with_residual = true};
  check(kernel, deep);
  Case gated = deep;
  gated.n_part = 2, gated.gated = true, gated.n_thread = 2;
  check(kernel, gated);
  Case wide = deep;
  wide.shape = {270, 2080, 780};
  if (rounds(kernel)) wide.x_type = DType::bf16;
  check(kernel, wide);
  for (const std::int64_t depth : {9000, 17000}) {  // of one row: one block, and several
    deep.shape = gated.shape = {1, depth, 70};
    check(kernel, deep);
    check(kernel, gated);
  }
}

void check_threads(const LinearKernel& kernel) {
  for (int n_thread : {2, 3, 7, 64})
    for (const Shape& shape : {Shape{1, 33, 17}, Shape{50, 72, 205}, Shape{300, 33, 530}}) {
      check(kernel, {.shape = shape, .with_bias = true, .n_thread = n_thread});
      check(kernel, {.shape = shape, .activation = Activation::silu, .n_part = 2, .gated = true, .n_thread = n_thread});
      check(kernel, {.shape = shape, .n_part = 3, .n_thread = n_thread});
    }
}

/// Sums are made in the same order whoever makes them, so that a robot's answer does not depend on its cores.
void check_bytes(const LinearKernel& kernel) {
  Trial one(kernel, {.shape = {97, 1151, 205}}), many(kernel, {.shape = {97, 1151, 205}, .n_thread = 5});
  one.run(), many.run();
  CHECK(one.y(0) == many.y(0));
}

/// Who rounds x to bf16 takes it so, and gives y so: one product's y is the next one's x.
void check_rounded_after(Activation activation, const LinearKernel& kernel) {
  const Case plain = {.shape = {97, 72, 205}, .activation = activation, .with_bias = true, .n_thread = 2};
  Case from = plain, to = plain;
  from.x_type = DType::bf16, to.y_type = DType::bf16;
  Trial expected(kernel, plain), rounded_x(kernel, from), rounded_y(kernel, to);
  expected.run(), rounded_x.run(), rounded_y.run();
  CHECK(rounded_x.y(0) == expected.y(0));
  int wrong = 0;
  for (std::int64_t row = 0; row < 97; ++row)
    for (std::int64_t n = 0; n < 205; ++n) {
      // An activation that is rounded next need not be exact before: its bf16 may be the neighbour.
      const float exact = expected.y(0)[static_cast<std::size_t>(1 + row * 205 + n)];
      wrong += !(std::abs(rounded_y.rounded_y(row, n) - exact) <= (0x1p-8f + 0x1p-13f) * std::abs(exact) + 0x1p-119f);
    }
  // What fills the tiles up to whole ones is multiplied by zeros.
  if (kernel.rounded == RoundedLayout::tiles)
    for (std::int64_t row = 0; row < 97; ++row)
      for (std::int64_t n = 205; n < 224; ++n) wrong += rounded_y.rounded_y(row, n) != 0;
  CHECK(wrong == 0);
}

void check_rounded(const LinearKernel& kernel) {
  CHECK(rounds(kernel) == (std::strstr(kernel.name, "_bf16") || std::strstr(kernel.name, "amx")));
  if (!rounds(kernel)) return;
  for (Activation activation : kActivations) check_rounded_after(activation, kernel);
}

[[maybe_unused]] void check_blocks(const LinearKernel& tiles) {
  const auto n_block = [&](std::int64_t n_row, std::int64_t d_in, std::int64_t d_out, int n_thread) {
    LinearJob job = {};
    job.n_row = n_row, job.d_in = d_in, job.n_part = 1;
    job.part[0].type = DType::bf16, job.part[0].d_out = d_out;
    const std::int64_t n_item = tiles.cut(job, n_thread), n = ceil_div(n_row, job.block_rows);
    CHECK(n_item == n * job.n_group);
    return n;
  };
  for (const auto& [d_in, d_out] : {std::pair{2048, 16384}, std::pair{16384, 2048}}) {
    CHECK(n_block(560, d_in, d_out, 2) == 2);
    CHECK(n_block(816, d_in, d_out, 1) == 3);
    CHECK(n_block(816, d_in, d_out, 2) == 4);
    CHECK(n_block(816, d_in, d_out, 3) == 3);
    CHECK(n_block(816, d_in, d_out, 8) == 4);
    CHECK(n_block(200, d_in, d_out, 2) == 1);
  }
  CHECK(n_block(560, 2048, 2048, 2) == 3);  // a cache keeps these weights
}

const LinearKernel& row(const std::string& name) {
  for (const LinearKernel* kernel : linear_kernels())
    if (kernel->name == name) return *kernel;
  FAIL("no row " << name);
  return *linear_kernels().back();
}

}  // namespace

#define VLA_LINEAR_TEST(sentence, check)                                                                        \
  TEST_CASE("portable: " sentence) { check(row("portable")); }                                                  \
  TEST_CASE("neon: " sentence* doctest::skip(vla::test::lacks(kernel_set::neon))) { check(row("neon")); }       \
  TEST_CASE("neon_bf16: " sentence* doctest::skip(vla::test::lacks(kernel_set::neon_bf16))) {                   \
    check(row("neon_bf16"));                                                                                    \
  }                                                                                                             \
  TEST_CASE("neon_bf16, few rows: " sentence* doctest::skip(vla::test::lacks(kernel_set::neon_bf16))) {         \
    check(*row("neon_bf16").small_batch);                                                                       \
  }                                                                                                             \
  TEST_CASE("avx2: " sentence* doctest::skip(vla::test::lacks(kernel_set::avx2))) { check(row("avx2")); }       \
  VLA_EMULATED_TEST("avx512", sentence, check(kEmulatedLinearAvx512))                                           \
  VLA_EMULATED_TEST("avx512_bf16", sentence, check(kEmulatedLinearAvx512Bf16))                                  \
  VLA_EMULATED_TEST("amx", sentence, check(kEmulatedLinearAmx))                                                 \
  TEST_CASE("avx512: " sentence* doctest::skip(vla::test::lacks(kernel_set::avx512))) { check(row("avx512")); } \
  TEST_CASE("avx512_bf16: " sentence* doctest::skip(vla::test::lacks(kernel_set::avx512_bf16))) {               \
    check(row("avx512_bf16"));                                                                                  \
  }                                                                                                             \
  TEST_CASE("amx: " sentence* doctest::skip(vla::test::lacks(kernel_set::amx))) { check(row("amx")); }

VLA_LINEAR_TEST("products of any shape and storage type are within float32's rounding", check_shapes_and_types)
VLA_LINEAR_TEST("bias, activation, factor and residual follow the product", check_epilogues)
VLA_LINEAR_TEST("a gate multiplies, and products of one x stand side by side", check_gates_and_groups)
VLA_LINEAR_TEST("a product may be deeper than the caches", check_depths)
VLA_LINEAR_TEST("any number of threads computes every number once", check_threads)
VLA_LINEAR_TEST("what is multiplied as bf16 may come and leave as bf16", check_rounded)
VLA_LINEAR_TEST("the number of threads does not change a bit", check_bytes)

namespace {

/// BFMMLA's rounding: to the neighbour whose last bit is odd, where x is no float32.
float to_odd(double x) {
  float y = static_cast<float>(x);
  if (y == x) return y;
  if (std::abs(y) > std::abs(x)) y = std::nextafter(y, 0.0f);
  return std::bit_cast<float>(std::bit_cast<std::uint32_t>(y) | 1U);
}

}  // namespace

TEST_CASE("neon_bf16: pairs of products, and then sums, are rounded to odd" *
          doctest::skip(test::lacks(kernel_set::neon_bf16))) {
  constexpr std::int64_t kDepth = 96;
  Numbers numbers;
  std::vector<float> x = numbers.some(kDepth), w = numbers.some(kDepth), y = {0, test::kUntouched};
  const std::vector<std::byte> stored = test::store_as(DType::bf16, w);
  for (float& number : x) number = from_bf16(to_bf16(number));
  float sum = 0;
  for (std::size_t k = 1; k <= kDepth; k += 2)
    sum = to_odd(double{sum} + to_odd(double{x[k]} * w[k] + double{x[k + 1]} * w[k + 1]));
  const test::Pages packed = test::packed(row("neon_bf16"), {DType::bf16, kDepth, 1}, stored.data() + 2);
  LinearJob job = {};
  job.x = bytes(x), job.x_stride = job.d_in = kDepth, job.n_row = job.n_part = 1;
  job.part[0] = {DType::bf16, packed.get(), nullptr, nullptr, nullptr, bytes(y), 1};
  test::run_job(row("neon_bf16"), job, 1);
  CHECK(y[1] == sum);
}

TEST_CASE("every machine takes the first row that it can run, and ggml asks for none") {
  for (const KernelSet& set : usable_kernels())
    for (DType type : {DType::bf16, DType::f16, DType::f32}) {
      const LinearKernel* chosen = choose_linear({type, 768, 3072}, set.uses);
      const std::string expected = name_of(type == DType::bf16 ? set.uses : without_rounding(set.uses));
      CHECK((chosen == nullptr ? "ggml" : chosen->name) == expected);
    }
}

TEST_CASE("few rows go to a kernel that reads the same packed matrix and rounds nothing") {
  const MatrixDesc desc = {DType::bf16, 80, 70};
  for (const LinearKernel* kernel : linear_kernels()) {
    CHECK(&kernel->for_batch(1000) == kernel);
    if (kernel->small_batch == nullptr) continue;
    const LinearKernel& small_batch = kernel->for_batch(kernel->max_small_batch);
    CHECK(&small_batch == kernel->small_batch);
    CHECK(&kernel->for_batch(kernel->max_small_batch + 1) == kernel);
    CHECK(small_batch.rounded == RoundedLayout::none);
    CHECK((small_batch.pack == kernel->pack));
    CHECK(small_batch.packed_size(desc) == kernel->packed_size(desc));
  }
}

VLA_EMULATED_TEST("amx", "threads share blocks of rows evenly where weights come from memory for each block",
                  check_blocks(kEmulatedLinearAmx))

TEST_CASE("x is rounded to the nearest bf16, ties to even, as PyTorch rounds it") {
  CHECK(from_bf16(to_bf16(1.0f)) == 1.0f);
  CHECK(from_bf16(to_bf16(1.0f + 0x1p-8f)) == 1.0f);                                // a tie: 1 is even
  CHECK(from_bf16(to_bf16(1.0f + 3 * 0x1p-8f)) == 1.0f + 0x1p-6f);                  // a tie: the upper one is even
  CHECK(from_bf16(to_bf16(1.0f + 0x1p-8f + 0x1p-20f)) == 1.0f + 0x1p-7f);           // nearer to the upper one
  CHECK(from_bf16(to_bf16(-3.0e38f)) == doctest::Approx(-3.0e38).epsilon(0x1p-8));  // no overflow below the largest
  CHECK(std::isinf(from_bf16(to_bf16(std::numeric_limits<float>::max()))));         // as torch.bfloat16
  CHECK(std::isnan(from_bf16(to_bf16(std::numeric_limits<float>::quiet_NaN()))));
  CHECK(std::isnan(from_bf16(to_bf16(std::bit_cast<float>(0x7f800001U)))));  // rounding would make it infinite
}

}  // namespace linear_test

// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/gelu_erf.h"

#include <doctest/doctest.h>

#include <cmath>
#include <limits>
#include <vector>

#include "kernels/portable/vec_portable.h"
#include "support/kernel_rows.h"

namespace math_test {

using namespace vla;
using kernels::CpuKernels;

namespace {

using Function = double (*)(double);

double silu(double x) { return x / (1 + std::exp(-x)); }
double gelu_tanh(double x) { return x / (1 + std::exp(-2 * std::sqrt(2 / M_PI) * (x + 0.044715 * x * x * x))); }
double gelu_erf(double x) { return x / 2 * std::erfc(-x * M_SQRT1_2); }
double mish(double x) { return x * std::tanh(std::log1p(std::exp(x))); }

/// The distance of neighbouring float32 numbers where `exact` lies.
double unit(double exact) {
  constexpr double kSmallestNormal = 0x1p-126;
  if (std::abs(exact) < kSmallestNormal) return 0x1p-149;
  int exponent = 0;
  std::frexp(exact, &exponent);
  return std::ldexp(1.0, exponent - 24);
}

/// Finite numbers of every exponent and sign, the edges of the range, and many where e^-x outgrows what float32 can add
/// one to: there errors are largest.
std::vector<float> numbers() {
  std::vector<float> all = {0.0f, -0.0f, 0x1p-149f, -0x1p-149f, 0x1p-126f, -0x1p-126f, 3.4028235e38f, -3.4028235e38f};
  const auto add = [&](std::uint64_t begin, std::uint64_t end, std::uint64_t stride) {
    for (std::uint64_t bits = begin; bits < end; bits += stride)
      if (const float x = std::bit_cast<float>(static_cast<std::uint32_t>(bits)); std::isfinite(x)) all.push_back(x);
  };
  add(0, std::uint64_t{1} << 32, 1999);
  add(std::bit_cast<std::uint32_t>(-4.0f), std::bit_cast<std::uint32_t>(-32.0f), 41);
  return all;
}

double worst_error(kernels::RowKernel map, Function exact) {
  const std::vector<float> x = numbers();
  std::vector<float> y(x.size());
  map(x.data(), nullptr, nullptr, 0, y.data(), static_cast<std::int64_t>(x.size()));
  double worst = 0;
  for (std::size_t i = 0; i < x.size(); ++i) {
    const double expected = exact(x[i]), error = std::abs(y[i] - expected) / unit(expected);
    if (!(error <= worst)) worst = error;  // which a NaN is too
  }
  return worst;
}

void check_accuracy(const CpuKernels& kernels) {
  CHECK(worst_error(kernels.silu, silu) <= 2);
  CHECK(worst_error(kernels.gelu_tanh, gelu_tanh) <= 2);
  CHECK(worst_error(kernels.gelu_erf, gelu_erf) <= 2);
}

/// Below -80 float32 leaves the normal numbers on the way.
void check_mish(const CpuKernels& kernels) {
  const std::vector<float> x = numbers();
  std::vector<float> y(x.size());
  kernels.mish(x.data(), nullptr, nullptr, 0, y.data(), static_cast<std::int64_t>(x.size()));
  for (std::size_t i = 0; i < x.size(); ++i) {
    const double expected = mish(x[i]), most = x[i] < -80 ? 1e-32 : 4 * unit(expected);
    if (!(std::abs(y[i] - expected) <= most)) FAIL_CHECK(x[i] << ": " << y[i]);
  }
}

void check_not_finite(const CpuKernels& kernels) {
  const float infinity = std::numeric_limits<float>::infinity(), nan = std::numeric_limits<float>::quiet_NaN();
  for (kernels::RowKernel map : {kernels.silu, kernels.gelu_tanh, kernels.gelu_erf, kernels.mish}) {
    const float x[] = {infinity, -infinity, nan};
    float y[3] = {};
    map(x, nullptr, nullptr, 0, y, 3);
    CHECK(y[0] == infinity);
    CHECK_FALSE(std::isfinite(y[1]));
    CHECK(std::isnan(y[2]));
  }
}

void check_relu(const CpuKernels& kernels) {
  std::vector<float> x = numbers(), expected;
  for (float edge : {std::numeric_limits<float>::infinity(), -std::numeric_limits<float>::infinity()})
    x.push_back(edge);
  for (float value : x) expected.push_back(value > 0 ? value : 0);
  x.push_back(std::numeric_limits<float>::quiet_NaN());
  std::vector<float> y(x.size());
  kernels.relu(x.data(), nullptr, nullptr, 0, y.data(), static_cast<std::int64_t>(x.size()));
  CHECK(std::isnan(y.back()));
  y.pop_back();
  CHECK(y == expected);
  for (float& value : expected) value *= value;
  kernels.relu_squared(x.data(), nullptr, nullptr, 0, x.data(), static_cast<std::int64_t>(x.size()));
  CHECK(std::isnan(x.back()));
  x.pop_back();
  CHECK(x == expected);
}

void check_ends(const CpuKernels& kernels) {
  const std::vector<float> x(70, 1.0f);
  float expected = -1.0f;
  kernels.silu(x.data(), nullptr, nullptr, 0, &expected, 1);
  CHECK(expected != -1.0f);
  for (std::int64_t n = 0; n <= 66; ++n) {
    std::vector<float> y(70, -1.0f);
    kernels.silu(x.data() + 1, nullptr, nullptr, 0, y.data() + 1, n);  // one number off, so that nothing is aligned
    for (std::size_t i = 0; i < y.size(); ++i)
      CHECK(y[i] == (i >= 1 && i < 1 + static_cast<std::size_t>(n) ? expected : -1.0f));
  }
}

}  // namespace

VLA_KERNEL_TEST("silu and gelu are within two units in the last place over the whole range", check_accuracy)
VLA_KERNEL_TEST("mish is within four units in the last place down to -80", check_mish)
VLA_KERNEL_TEST("relu and its square keep what is above zero, and NaN", check_relu)
VLA_KERNEL_TEST("what is not finite stays so", check_not_finite)
VLA_KERNEL_TEST("a row of any length is mapped from its first number to its last, and nothing beyond", check_ends)

TEST_CASE("activations that are rounded to bf16 next err by 2^-13 of the result or by 2^-119") {
  using V = kernels::Portable;
  for (float x : numbers())
    for (const auto& [got, exact] : {std::pair(kernels::silu_for_bf16<V>(V::set(x))[0], silu(x)),
                                     std::pair(kernels::gelu_tanh_for_bf16<V>(V::set(x))[0], gelu_tanh(x)),
                                     std::pair(kernels::gelu_erf_for_bf16<V>(V::set(x))[0], gelu_erf(x))})
      if (!(std::abs(got - exact) <= 0x1p-13 * std::abs(exact) + 0x1p-119)) FAIL_CHECK(x << ": " << got);
}

}  // namespace math_test

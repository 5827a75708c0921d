// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/math.h"

#include <doctest/doctest.h>

#include <cmath>
#include <limits>
#include <vector>

#include "support/kernel_rows.h"

using namespace vla;
using kernels::CpuKernels;

namespace {

using Function = double (*)(double);

double silu(double x) { return x / (1 + std::exp(-x)); }
double gelu(double x) { return x / (1 + std::exp(-2 * std::sqrt(2 / M_PI) * (x + 0.044715 * x * x * x))); }

/// The distance of neighbouring float32 numbers where `exact` lies.
double unit(double exact) {
  constexpr double kSmallestNormal = 0x1p-126;
  if (std::abs(exact) < kSmallestNormal) return 0x1p-149;
  int exponent = 0;
  std::frexp(exact, &exponent);
  return std::ldexp(1.0, exponent - 24);
}

/// Finite numbers of every exponent and sign, one in `stride` of all that there are, and the edges of the range.
std::vector<float> numbers(std::uint64_t stride) {
  std::vector<float> all = {0.0f, -0.0f, 0x1p-149f, -0x1p-149f, 0x1p-126f, -0x1p-126f, 3.4028235e38f, -3.4028235e38f};
  for (std::uint64_t bits = 0; bits < (std::uint64_t{1} << 32); bits += stride)
    if (const float x = std::bit_cast<float>(static_cast<std::uint32_t>(bits)); std::isfinite(x)) all.push_back(x);
  return all;
}

double worst_error(CpuKernels::Map map, Function exact) {
  const std::vector<float> x = numbers(9973);
  std::vector<float> y(x.size());
  map(x.data(), y.data(), static_cast<std::int64_t>(x.size()));
  double worst = 0;
  for (std::size_t i = 0; i < x.size(); ++i) {
    const double expected = exact(x[i]);
    if (std::isinf(static_cast<float>(expected)))
      REQUIRE(y[i] == static_cast<float>(expected));
    else
      worst = std::max(worst, std::abs(y[i] - expected) / unit(expected));
  }
  return worst;
}

void check_accuracy(const CpuKernels& kernels) {
  CHECK(worst_error(kernels.exp, [](double x) { return std::exp(x); }) <= 1);
  CHECK(worst_error(kernels.silu, silu) <= 1);
  CHECK(worst_error(kernels.gelu_tanh, gelu) <= 1);
}

void check_not_finite(const CpuKernels& kernels) {
  const float infinity = std::numeric_limits<float>::infinity(), nan = std::numeric_limits<float>::quiet_NaN();
  for (CpuKernels::Map map : {kernels.silu, kernels.gelu_tanh})
    for (float x : {infinity, -infinity, nan}) {
      float y = 0;
      map(&x, &y, 1);
      CHECK_FALSE(std::isfinite(y));
    }
  const float x[] = {infinity, -infinity, nan};
  float y[3] = {};
  kernels.exp(x, y, 3);
  CHECK(y[0] == infinity);
  CHECK(y[1] == 0);
  CHECK(std::isnan(y[2]));
}

void check_ends(const CpuKernels& kernels) {
  const std::vector<float> x(70, 1.0f);
  for (std::int64_t n = 0; n <= 66; ++n) {
    std::vector<float> y(70, -1.0f);
    kernels.exp(x.data() + 1, y.data() + 1, n);  // one number off, so that nothing is aligned
    for (std::size_t i = 0; i < y.size(); ++i)
      CHECK(y[i] == (i >= 1 && i < 1 + static_cast<std::size_t>(n) ? std::exp(1.0f) : -1.0f));
  }
}

}  // namespace

VLA_KERNEL_TEST("exp, silu and gelu are within one unit in the last place over the whole range", check_accuracy)
VLA_KERNEL_TEST("what is not finite stays so, but for the exponential of minus infinity", check_not_finite)
VLA_KERNEL_TEST("a row of any length is mapped from its first number to its last, and nothing beyond", check_ends)

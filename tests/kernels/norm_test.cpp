// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
// Row kernels that take more than x, against their definitions.
#include <doctest/doctest.h>

#include <cmath>
#include <vector>

#include "support/graph_runner.h"
#include "support/kernel_rows.h"

namespace norm_test {

using namespace vla;
using kernels::CpuKernels;
using test::ramp;

namespace {

constexpr float kEps = 1e-5f;
constexpr int kWidths[] = {1, 3, 8, 15, 16, 17, 31, 33, 64, 720, 768, 1151};

std::vector<double> by_hand(const std::vector<float>& x, const std::vector<float>& weight,
                            const std::vector<float>& bias, bool centred) {
  double mean = 0, square = 0;
  for (float value : x) mean += centred ? value / static_cast<double>(x.size()) : 0;
  for (float value : x) square += (value - mean) * (value - mean) / static_cast<double>(x.size());
  std::vector<double> y;
  for (std::size_t i = 0; i < x.size(); ++i)
    y.push_back((x[i] - mean) / std::sqrt(square + double{kEps}) * weight[i] + (bias.empty() ? 0 : bias[i]));
  return y;
}

/// Sums of d numbers in float32 by lanes, some roundings for each result, and values of order 10.
void check_norm(kernels::RowKernel norm, bool centred, bool biased) {
  for (int d : kWidths) {
    CAPTURE(d);
    const auto n = static_cast<std::size_t>(d);
    std::vector<float> x = ramp(n, 3), y(n);
    const std::vector<float> weight = ramp(n, 2), bias = biased ? ramp(n, 1) : std::vector<float>();
    for (float& value : x) value += 2;  // a mean that is not small
    norm(x.data(), weight.data(), biased ? bias.data() : nullptr, kEps, y.data(), d);
    const auto expected = by_hand(x, weight, bias, centred);
    for (std::size_t i = 0; i < n; ++i) CHECK(std::abs(y[i] - expected[i]) <= 4e-6);
  }
}

void check_norms(const CpuKernels& kernels) {
  for (bool biased : {false, true}) {
    check_norm(kernels.layer_norm, true, biased);
    check_norm(kernels.rms_norm, false, biased);
  }
}

/// Rows of any length, in place too: one vector more or less must not matter.
void check_pairs_of_rows(const CpuKernels& kernels) {
  for (int d : kWidths) {
    CAPTURE(d);
    const auto n = static_cast<std::size_t>(d);
    const std::vector<float> x = ramp(n, 3), w = ramp(n + 1, 2);
    for (const bool in_place : {false, true}) {
      std::vector<float> room = x, y(n, NAN), sum(n), product(n), scaled(n);
      float* to = in_place ? room.data() : y.data();
      const auto run = [&](kernels::RowKernel kernel, std::vector<float>& result) {
        room = x;
        kernel(room.data(), w.data() + 1, nullptr, 1.5f, to, d);
        result.assign(to, to + n);
      };
      run(kernels.add, sum), run(kernels.multiply, product), run(kernels.scale, scaled);
      for (std::size_t i = 0; i < n; ++i) {
        CHECK(sum[i] == x[i] + w[i + 1]);
        CHECK(product[i] == x[i] * w[i + 1]);
        CHECK(scaled[i] == x[i] * 1.5f);
      }
    }
  }
}

void check_rotation(const CpuKernels& kernels) {
  for (int d : {2, 6, 16, 34, 64, 66, 256}) {
    CAPTURE(d);
    const auto n = static_cast<std::size_t>(d), half = n / 2;
    const std::vector<float> x = ramp(n, 3), table = ramp(n, 1);
    std::vector<float> apart(n), in_place = x;
    kernels.rotate_half(x.data(), table.data(), nullptr, 0, apart.data(), d);
    kernels.rotate_half(in_place.data(), table.data(), nullptr, 0, in_place.data(), d);
    CHECK(apart == in_place);
    for (std::size_t i = 0; i < half; ++i) {
      CHECK(std::abs(apart[i] - (double{x[i]} * table[i] - double{x[half + i]} * table[half + i])) <= 1e-6);
      CHECK(std::abs(apart[half + i] - (double{x[half + i]} * table[i] + double{x[i]} * table[half + i])) <= 1e-6);
    }
  }
}

}  // namespace

VLA_KERNEL_TEST("layer and RMS norms of any width agree with their definitions", check_norms)

VLA_KERNEL_TEST("sums, products and multiples of rows of any length, in place too", check_pairs_of_rows)
VLA_KERNEL_TEST("pairs of a row turn by the angles of a table, in place too", check_rotation)

}  // namespace norm_test

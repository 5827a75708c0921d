// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/norm.h"

#include <cmath>

#include "support/graph_runner.h"
#include "support/kernel_rows.h"

using namespace vla;
using kernels::CpuKernels;
using test::ramp;
using test::run_graph;

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
void check_norm(CpuKernels::Norm norm, bool centred, bool biased) {
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

/// Rows that are parts of wider ones, as a view of a joint product leaves them.
Tensor views(Graph& g, const std::vector<float>& x, int d, int n) {
  const Tensor wide = g.store().add_constant(x, {2 * d, n, 2});
  return ggml_view_3d(g.context(), wide.node(), d, n, 2, wide.node()->nb[1], wide.node()->nb[2], sizeof(float));
}

}  // namespace

VLA_KERNEL_TEST("layer and RMS norms of any width agree with their definitions", check_norms)

TEST_CASE("norms of rows that lie apart agree with ggml's own operations") {
  constexpr int kD = 33, kN = 5;
  const std::vector<float> x = ramp(2 * kD * kN * 2, 3), weight = ramp(kD, 2), bias = ramp(kD, 1);
  for (bool centred : {false, true}) {
    const auto build = [&](Graph& g) {
      const Tensor w = g.store().add_constant(weight, {kD}), b = g.store().add_constant(bias, {kD});
      const auto norm = centred ? kernels::layer_norm : kernels::rms_norm;
      return norm(g, views(g, x, kD, kN), w, b, kEps);
    };
    const auto got = run_graph(build), expected = run_graph(build, "ggml");
    REQUIRE(got.size() == expected.size());
    for (std::size_t i = 0; i < got.size(); ++i) CHECK(std::abs(got[i] - expected[i]) <= 4e-6);
  }
}

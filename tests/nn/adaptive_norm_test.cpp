// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Operations with weights of their own, against their definitions in double precision.
#include "nn/adaptive_norm.h"

#include <doctest/doctest.h>

#include <cmath>

#include "kernels/kernel_set.h"
#include "nn/mlp.h"
#include "nn/norm.h"
#include "support/graph_runner.h"
#include "support/param_set.h"

namespace adaptive_norm_test {

using namespace vla;
using test::ramp;

namespace {

constexpr int kWidth = 6, kCondition = 4, kToken = 3, kHidden = 5;
constexpr float kEps = 1e-3f;  // large enough to show

using Piece = test::ParamSet::Piece;  // of a module under `m`

/// Declares a `Made` on these weights, and returns the values of what `use` makes with it.
template <class Made, class Make, class Use>
std::vector<float> run_module(const std::vector<Piece>& pieces, const Make& make, const Use& use) {
  test::ParamSet params(pieces);
  const Made module = make(params.scope("m"));
  return test::run_graph(params.list(), [&](Graph& g) { return use(module, g); });
}

float at(const std::vector<float>& values, int i) { return values[static_cast<std::size_t>(i)]; }

/// Row `row` of a matrix times column `column` of x, both with n numbers.
template <class X>
double dot(const std::vector<float>& w, int row, const std::vector<X>& x, int column, int n) {
  double sum = 0;
  for (int i = 0; i < n; ++i) sum += double{at(w, row * n + i)} * x[static_cast<std::size_t>(column * n + i)];
  return sum;
}

}  // namespace

TEST_CASE("an adaptive norm scales, shifts and gates by what its condition says") {
  const auto weight = ramp(3 * kWidth * kCondition, 1), bias = ramp(3 * kWidth, 2), x = ramp(kWidth * kToken, 3),
             y = ramp(kWidth * kToken, 1), condition = ramp(kCondition, 1.5f);
  const std::vector<Piece> pieces = {{"m.dense.weight", {kCondition, 3 * kWidth}, weight},
                                     {"m.dense.bias", {3 * kWidth}, bias}};
  const auto got = run_module<AdaRmsNorm>(
      pieces, [](const Scope& s) { return AdaRmsNorm(s, kWidth, kCondition, kEps); },
      [&](const AdaRmsNorm& norm, Graph& g) {
        const Tensor m = norm.modulation(g, test::constant(g, condition, {kCondition, 1}));
        const Tensor h = norm(g, test::constant(g, x, {kWidth, kToken}), m);
        return gated_add(g, h, test::constant(g, y, {kWidth, kToken}), norm.gate(g, m));
      });
  REQUIRE(got.size() == x.size());
  const auto modulation = [&](int row) { return dot(weight, row, condition, 0, kCondition) + at(bias, row); };
  for (int token = 0; token < kToken; ++token)
    for (int i = 0; i < kWidth; ++i) {
      const std::vector<float> row(x.begin() + token * kWidth, x.begin() + (token + 1) * kWidth);
      const double normed = at(row, i) / std::sqrt(dot(row, 0, row, 0, kWidth) / kWidth + double{kEps});
      const double h = normed * (1 + modulation(i)) + modulation(kWidth + i);
      CHECK(at(got, token * kWidth + i) ==
            doctest::Approx(h + at(y, token * kWidth + i) * modulation(2 * kWidth + i)).epsilon(1e-5));
    }
}

TEST_CASE("an MLP activates what goes up by the activation it was given") {
  const auto up = ramp(kHidden * kWidth, 1), up_bias = ramp(kHidden, 2), down = ramp(kWidth * kHidden, 1.5f),
             down_bias = ramp(kWidth, 1), x = ramp(kWidth * kToken, 2);
  const std::vector<Piece> pieces = {{"m.ffn_up.weight", {kWidth, kHidden}, up},
                                     {"m.ffn_up.bias", {kHidden}, up_bias},
                                     {"m.ffn_down.weight", {kHidden, kWidth}, down},
                                     {"m.ffn_down.bias", {kWidth}, down_bias}};
  using Function = double (*)(double);
  const std::pair<Activation, Function> activations[] = {
      {Activation::gelu_erf, [](double u) { return u / 2 * std::erfc(-u * M_SQRT1_2); }},
      {Activation::relu, [](double u) { return std::max(u, 0.0); }}};
  for (const auto& [activation, exact] : activations) {
    const auto got = run_module<Mlp>(
        pieces, [activation = activation](const Scope& s) { return Mlp(s, kWidth, kHidden, activation); },
        [&](const Mlp& mlp, Graph& g) {
          return mlp(g, test::constant(g, x, {kWidth, kToken}));
        });
    REQUIRE(got.size() == x.size());
    for (int token = 0; token < kToken; ++token) {
      std::vector<double> hidden;
      for (int j = 0; j < kHidden; ++j) hidden.push_back(exact(dot(up, j, x, token, kWidth) + at(up_bias, j)));
      for (int i = 0; i < kWidth; ++i)
        CHECK(at(got, token * kWidth + i) ==
              doctest::Approx(dot(down, i, hidden, 0, kHidden) + at(down_bias, i)).epsilon(1e-5));
    }
  }
}

TEST_CASE("an adaptive LayerNorm takes scale and shift in the order of its kind") {
  using Order = AdaLayerNorm::Order;
  const auto weight = ramp(2 * kWidth * kWidth, 1), bias = ramp(2 * kWidth, 2), x = ramp(kWidth * kToken, 3),
             condition = ramp(kWidth, 1.5f);
  for (const Order order : {Order::scale_shift, Order::shift_scale}) {
    const auto got = run_module<std::vector<AdaLayerNorm>>(
        {{"m.weight", {kWidth, 2 * kWidth}, weight}, {"m.bias", {2 * kWidth}, bias}},
        [&](const Scope& s) { return std::vector{AdaLayerNorm(s, kWidth, kEps, order)}; },
        [&](const std::vector<AdaLayerNorm>& norm, Graph& g) {
          const Tensor m = norm[0].modulation(g, test::constant(g, condition, {kWidth, 1}));
          return norm[0].forward(g, test::constant(g, x, {kWidth, kToken}), m);
        });
    REQUIRE(got.size() == x.size());
    const auto modulation = [&](int row) { return dot(weight, row, condition, 0, kWidth) + at(bias, row); };
    const int scale = order == Order::scale_shift ? 0 : kWidth, shift = kWidth - scale;
    for (int token = 0; token < kToken; ++token) {
      double mean = 0, variance = 0;
      for (int i = 0; i < kWidth; ++i) mean += at(x, token * kWidth + i) / kWidth;
      for (int i = 0; i < kWidth; ++i) variance += std::pow(at(x, token * kWidth + i) - mean, 2) / kWidth;
      for (int i = 0; i < kWidth; ++i)
        CHECK(at(got, token * kWidth + i) ==
              doctest::Approx((at(x, token * kWidth + i) - mean) / std::sqrt(variance + kEps) *
                                  (1 + modulation(scale + i)) +
                              modulation(shift + i))
                  .epsilon(1e-5));
    }
  }
}

TEST_CASE("a norm without weights has mean 0 and a variance just below 1") {
  const auto x = ramp(kWidth * kToken, 3);
  for (const KernelSet& set : usable_kernels()) {
    const auto got = test::run_graph(
        [&](Graph& g) {
          return layer_norm(g, test::constant(g, x, {kWidth, kToken}), kEps);
        },
        name_of(set));
    for (int token = 0; token < kToken; ++token) {
      double mean = 0, square = 0;
      for (int i = 0; i < kWidth; ++i) mean += at(got, token * kWidth + i) / double{kWidth};
      for (int i = 0; i < kWidth; ++i) square += std::pow(at(got, token * kWidth + i), 2) / kWidth;
      CHECK(mean == doctest::Approx(0).epsilon(1e-6));
      CHECK(square < 1);
      CHECK(square == doctest::Approx(1).epsilon(1e-2));
    }
  }
}

TEST_CASE("a GELU-gated MLP multiplies the activated gate with what goes up") {
  const auto gate = ramp(kHidden * kWidth, 2), up = ramp(kHidden * kWidth, 1), down = ramp(kWidth * kHidden, 1.5f),
             x = ramp(kWidth * kToken, 2);
  const std::vector<Piece> pieces = {{"m.ffn_gate.weight", {kWidth, kHidden}, gate},
                                     {"m.ffn_up.weight", {kWidth, kHidden}, up},
                                     {"m.ffn_down.weight", {kHidden, kWidth}, down}};
  const auto got = run_module<GatedMlp>(
      pieces, [](const Scope& s) { return GatedMlp(s, kWidth, kHidden, Activation::gelu_tanh); },
      [&](const GatedMlp& mlp, Graph& g) {
        return mlp(g, test::constant(g, x, {kWidth, kToken}));
      });
  REQUIRE(got.size() == x.size());
  for (int token = 0; token < kToken; ++token) {
    std::vector<double> hidden;
    for (int j = 0; j < kHidden; ++j) {
      const double u = dot(gate, j, x, token, kWidth);
      hidden.push_back(0.5 * u * (1 + std::tanh(std::sqrt(2 / M_PI) * (u + 0.044715 * u * u * u))) *
                       dot(up, j, x, token, kWidth));
    }
    for (int i = 0; i < kWidth; ++i)
      CHECK(at(got, token * kWidth + i) == doctest::Approx(dot(down, i, hidden, 0, kHidden)).epsilon(1e-5));
  }
}

}  // namespace adaptive_norm_test

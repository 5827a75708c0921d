// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "nn/adaptive_norm.h"

#include <fmt/format.h>

#include <algorithm>

namespace vla {
namespace {

/// Adds 1 to the first `count` elements of every column, once at load instead of in every step: scales become factors
/// (1 + scale).
Tensor scales_to_factors(Graph& g, Tensor modulation, int first, int count) {
  const std::int64_t n = modulation.dim(0);
  const Tensor one = g.constant(fmt::format("adaptive_norm/{}/{}/{}", n, first, count), {n, 1, 1, 1}, [&] {
    std::vector<float> values(static_cast<std::size_t>(n), 0.0f);
    std::fill_n(values.begin() + first, count, 1.0f);
    return values;
  });
  return add(g, modulation, one);
}

}  // namespace

AdaRmsNorm::AdaRmsNorm(const Scope& s, int d, int d_condition, float eps)
    : Module(s), d_(d), eps_(eps), dense_(s / "dense", d_condition, 3 * d, Bias::yes) {}

Tensor AdaRmsNorm::modulation(Graph& g, Tensor condition) const {
  return scales_to_factors(g, dense_(g, condition), 0, d_);
}

Tensor AdaRmsNorm::forward(Graph& g, Tensor x, Tensor modulation) const {
  const Tensor factor = slice_features(g, modulation, 0, d_), shift = slice_features(g, modulation, d_, d_);
  return g.add(op::Norm{op::NormKind::rms, eps_}, {x, factor, shift});
}

Tensor AdaRmsNorm::gate(Graph& g, Tensor modulation) const { return slice_features(g, modulation, 2 * d_, d_); }

AdaLayerNorm::AdaLayerNorm(const Scope& s, int d, float eps, Order order)
    : d_(d), first_scale_(order == Order::scale_shift ? 0 : d), eps_(eps), dense_(s, d, 2 * d, Bias::yes) {}

Tensor AdaLayerNorm::modulation(Graph& g, Tensor condition) const {
  return scales_to_factors(g, dense_(g, condition), first_scale_, d_);
}

Tensor AdaLayerNorm::forward(Graph& g, Tensor x, Tensor modulation) const {
  const Tensor factor = slice_features(g, modulation, first_scale_, d_);
  const Tensor shift = slice_features(g, modulation, d_ - first_scale_, d_);
  return g.add(op::Norm{op::NormKind::layer, eps_}, {x, factor, shift});
}

Tensor gated_add(Graph& g, Tensor x, Tensor y, Tensor gate) { return add(g, x, multiply(g, y, gate)); }

}  // namespace vla

// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "nn/adaptive_norm.h"

#include <fmt/format.h>

#include <algorithm>

#include "kernels/norm.h"
#include "nn/tokens.h"

namespace vla {
namespace {

/// Every column with 1 added to `count` of its numbers, once and not in every step: scales become factors (1 + scale).
Tensor scales_to_factors(Graph& g, Tensor modulation, int first, int count) {
  const std::int64_t n = modulation.dim(0);
  const Tensor one = g.constant(fmt::format("adaptive_norm/{}/{}/{}", n, first, count), [&](Store& store) {
    std::vector<float> values(static_cast<std::size_t>(n), 0.0f);
    std::fill_n(values.begin() + first, count, 1.0f);
    return store.add_constant(std::move(values), {n});
  });
  return add(g, modulation, one);
}

}  // namespace

AdaptiveRmsNorm::AdaptiveRmsNorm(const Scope& s, int d, int d_condition, float eps)
    : Module(s), d_(d), eps_(eps), dense_(s / "dense", d_condition, 3 * d, Bias::yes) {}

Tensor AdaptiveRmsNorm::modulation(Graph& g, Tensor condition) const {
  return scales_to_factors(g, dense_(g, condition), 0, d_);
}

Tensor AdaptiveRmsNorm::forward(Graph& g, Tensor x, Tensor modulation) const {
  const Tensor factor = slice_features(g, modulation, 0, d_), shift = slice_features(g, modulation, d_, d_);
  return kernels::rms_norm(g, x, factor, shift, eps_);
}

Tensor AdaptiveRmsNorm::gate(Graph& g, Tensor modulation) const { return slice_features(g, modulation, 2 * d_, d_); }

AdaptiveLayerNorm::AdaptiveLayerNorm(const Scope& s, int d, float eps, Order order)
    : d_(d), first_scale_(order == Order::scale_shift ? 0 : d), eps_(eps), dense_(s, d, 2 * d, Bias::yes) {}

Tensor AdaptiveLayerNorm::modulation(Graph& g, Tensor condition) const {
  return scales_to_factors(g, dense_(g, condition), first_scale_, d_);
}

Tensor AdaptiveLayerNorm::forward(Graph& g, Tensor x, Tensor modulation) const {
  const Tensor factor = slice_features(g, modulation, first_scale_, d_);
  return kernels::layer_norm(g, x, factor, slice_features(g, modulation, d_ - first_scale_, d_), eps_);
}

Tensor gated_add(Graph& g, Tensor x, Tensor y, Tensor gate) { return add(g, x, multiply(g, y, gate)); }

Tensor slice_features(Graph& g, Tensor x, int first, int count) {
  return ggml_view_1d(g.context(), x.node(), count, static_cast<std::size_t>(first) * sizeof(float));
}

}  // namespace vla

// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "nn/adaptive_norm.h"

#include <fmt/format.h>

#include "kernels/norm.h"
#include "nn/tokens.h"

namespace vla {

AdaptiveRmsNorm::AdaptiveRmsNorm(const Scope& s, int d, int d_condition, float eps)
    : Module(s), d_(d), eps_(eps), dense_(s / "dense", d_condition, 3 * d, Bias::yes) {}

Tensor AdaptiveRmsNorm::modulation(Graph& g, Tensor condition) const {
  // The 1 of (1 + scale) is added here, once, and not in every step.
  const Tensor one = g.constant(fmt::format("adaptive_norm/{}", d_), [&](Store& store) {
    std::vector<float> values(3 * static_cast<std::size_t>(d_), 0.0f);
    std::fill_n(values.begin(), d_, 1.0f);
    return store.add_constant(std::move(values), {3 * d_});
  });
  return ggml_add(g.context(), dense_(g, condition).node(), one.node());
}

Tensor AdaptiveRmsNorm::forward(Graph& g, Tensor x, Tensor modulation) const {
  const Tensor factor = slice_features(g, modulation, 0, d_), shift = slice_features(g, modulation, d_, d_);
  return kernels::rms_norm(g, x, factor, shift, eps_);
}

Tensor AdaptiveRmsNorm::gate(Graph& g, Tensor modulation) const { return slice_features(g, modulation, 2 * d_, d_); }

Tensor gated_add(Graph& g, Tensor x, Tensor y, Tensor gate) { return add(g, x, multiply(g, y, gate)); }

Tensor slice_features(Graph& g, Tensor x, int first, int count) {
  return ggml_view_1d(g.context(), x.node(), count, static_cast<std::size_t>(first) * sizeof(float));
}

}  // namespace vla

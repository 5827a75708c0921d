// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "nn/group_norm.h"

#include "nn/norm.h"
#include "nn/tokens.h"

namespace vla {

GroupNorm::GroupNorm(const Scope& s, int d, int n_group, float eps)
    : Module(s), n_group_(n_group), weight_(s.vector("weight", d)), bias_(s.vector("bias", d)), eps_(eps) {
  s.require(n_group > 0 && d % n_group == 0, "weight", "whole groups of features",
            std::to_string(d) + " features in " + std::to_string(n_group) + " groups");
}

/// Moves the values of a group into one row, normalizes the row, and moves the values back.
Tensor GroupNorm::forward(Graph& g, Tensor x) const {
  const std::int64_t d = x.dim(0) / n_group_, n_place = x.dim(1) * x.dim(2), n_view = x.dim(3);
  const auto exchanged = [&](Tensor y, const Shape& shape) { return permute(g, reshape(g, y, shape), {0, 2, 1, 3}); };
  const Tensor groups = exchanged(x, {d, n_group_, n_place, n_view});  // [d, n_place, n_group, n_view]
  const Tensor normed = layer_norm(g, reshape(g, groups, {d * n_place, n_group_, n_view, 1}), eps_);
  const Tensor places = exchanged(normed, {d, n_place, n_group_, n_view});
  return add(g, multiply(g, reshape(g, places, x.shape()), g.parameter(weight_)), g.parameter(bias_));
}

}  // namespace vla

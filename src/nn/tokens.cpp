// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "nn/tokens.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>

namespace vla {

Tensor slice(Graph& g, Tensor x, int dim, int first, int count) {
  Shape shape = x.shape();
  shape[static_cast<std::size_t>(dim)] = count;
  return g.add(op::Slice{dim, first}, {x}, shape);
}

Tensor full(Graph& g, float value, std::int64_t d, std::int64_t n) {
  return g.constant(fmt::format("full/{}/{}/{}", value, d, n), {d, n, 1, 1},
                    [&] { return std::vector<float>(static_cast<std::size_t>(d * n), value); });
}

Tensor repeat_like(Graph& g, Tensor x, Tensor like) { return g.add(op::Repeat{}, {x}, {x.dim(0), like.dim(1), 1, 1}); }

Tensor flatten_views(Graph& g, Tensor x) { return g.add(op::Reshape{}, {x}, {x.dim(0), x.dim(1) * x.dim(2), 1, 1}); }

Tensor prepend_tokens(Graph& g, Tensor tokens, Tensor x) {
  return concat_tokens(g, {g.add(op::Repeat{}, {tokens}, {x.dim(0), tokens.dim(1), x.dim(2), 1}), x});
}

Tensor zero_features_after(Graph& g, Tensor x, int count) {
  const std::int64_t d = x.dim(0);
  const Tensor kept = g.constant(fmt::format("zero_features_after/{}/{}", d, count), {d, 1, 1, 1}, [&] {
    std::vector<float> values(static_cast<std::size_t>(d), 0.0f);
    std::fill_n(values.begin(), count, 1.0f);
    return values;
  });
  return multiply(g, x, kept);
}

Tensor flatten(Graph& g, Tensor x) { return g.add(op::Reshape{}, {x}, {x.dim(0) * x.dim(1), 1, 1, 1}); }

Tensor reshape_width(Graph& g, Tensor x, std::int64_t d) {
  return g.add(op::Reshape{}, {x}, {d, x.dim(1) * x.dim(0) / d, x.dim(2), 1});
}

Tensor pixel_shuffle(Graph& g, Tensor x, int factor) {
  return pixel_shuffle(g, x, static_cast<int>(std::lround(std::sqrt(static_cast<double>(x.dim(1))))), factor);
}

}  // namespace vla

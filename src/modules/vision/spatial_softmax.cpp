// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/vision/spatial_softmax.h"

#include "nn/attention.h"
#include "nn/tokens.h"

namespace vla {
namespace {

constexpr int kHead = 4;  // features of a head; scores are divided by its square root

}  // namespace

SpatialSoftmax::SpatialSoftmax(const Scope& s, int d_in, int n_cell, int n_keypoint)
    : Module(s), map_(s, d_in, n_keypoint, Bias::yes), places_(s.vector("places", 2 * n_cell)) {}

/// An attention with one head per keypoint. The query is (2, 0, 0, 0) and scores are divided by sqrt(4), so a cell's
/// score is the first number of its key. A cell's value is (column, row, 0, 0).
Tensor SpatialSoftmax::forward(Graph& g, Tensor x) const {
  const Tensor map = map_.forward(g, x);
  const std::int64_t n_head = map.dim(0), n_cell = map.dim(1) * map.dim(2), n_view = map.dim(3);
  const auto of_heads = [&](Tensor values, std::int64_t n) {
    return g.add(op::Repeat{}, {values}, {values.dim(0), n_head, n, n_view});
  };
  const auto zeros = [&](int count) { return of_heads(reshape(g, full(g, 0, count, 1), {count, 1, 1, 1}), n_cell); };
  const Tensor query = g.constant("spatial_softmax", {kHead, 1, 1, 1}, [] { return std::vector<float>{2, 0, 0, 0}; });
  const Tensor key = concat(g, {reshape(g, map, {1, n_head, n_cell, n_view}), zeros(kHead - 1)}, 0);
  const Tensor places = of_heads(reshape(g, g.parameter(places_), {2, 1, n_cell, 1}), n_cell);
  const Tensor seen = attention(g, of_heads(query, 1), {{key, concat(g, {places, zeros(kHead - 2)}, 0)}}, {});
  const Tensor points = slice_features(g, reshape(g, seen, {kHead, n_head, n_view, 1}), 0, 2);
  return reshape(g, points, {2 * n_head, n_view, 1, 1});
}

}  // namespace vla

// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "nn/tokens.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>

#include "kernels/elementwise.h"

namespace vla {

Tensor concat_tokens(Graph& g, std::initializer_list<Tensor> parts) { return concat_tokens(g, std::vector(parts)); }

Tensor concat_tokens(Graph& g, const std::vector<Tensor>& parts) {
  Tensor all;
  for (Tensor part : parts) all = all ? kernels::join(g, all, part, 1) : part;
  return all;
}

Tensor slice_ids(Graph& g, Tensor ids, int first, int count) {
  return ggml_view_1d(g.context(), ids.node(), count, static_cast<std::size_t>(first) * ids.node()->nb[0]);
}

Tensor slice_keys(Graph& g, Tensor x, int first, int count) {
  const ggml_tensor* node = x.node();
  return ggml_view_3d(g.context(), x.node(), x.dim(0), x.dim(1), count, node->nb[1], node->nb[2],
                      static_cast<std::size_t>(first) * node->nb[2]);
}

Tensor append_keys(Graph& g, Tensor past, Tensor present) { return kernels::join(g, past, present, 2); }

Tensor concat_features(Graph& g, Tensor first, Tensor second) {
  return ggml_concat(g.context(), first.node(), second.node(), 0);
}

Tensor slice_tokens(Graph& g, Tensor x, int first, int count) {
  const std::size_t token = x.node()->nb[1];
  // Tokens of one view are in one piece, which some operations of ggml see by the stride of views that there are not.
  const std::size_t view = x.dim(2) == 1 ? static_cast<std::size_t>(count) * token : x.node()->nb[2];
  return ggml_view_3d(g.context(), x.node(), x.dim(0), count, x.dim(2), token, view,
                      static_cast<std::size_t>(first) * token);
}

Tensor filled(Graph& g, float value, std::int64_t d, std::int64_t n) {
  return g.constant(fmt::format("filled/{}/{}/{}", value, d, n), [&](Store& store) {
    return store.add_constant(std::vector<float>(static_cast<std::size_t>(d * n), value), {d, n});
  });
}

Tensor repeat_like(Graph& g, Tensor x, Tensor like) {
  return ggml_repeat_4d(g.context(), x.node(), x.dim(0), like.dim(1), 1, 1);
}

Tensor column(Graph& g, Tensor table, Tensor index) { return ggml_get_rows(g.context(), table.node(), index.node()); }

Tensor add(Graph& g, Tensor a, Tensor b) { return ggml_add(g.context(), a.node(), b.node()); }

Tensor scale(Graph& g, Tensor x, float factor) {
  return ggml_scale(g.context(), kernels::contiguous(g, x).node(), factor);
}

Tensor multiply(Graph& g, Tensor x, Tensor factor) { return ggml_mul(g.context(), x.node(), factor.node()); }

Tensor flatten_views(Graph& g, Tensor x) {
  return ggml_reshape_2d(g.context(), kernels::contiguous(g, x).node(), x.dim(0), x.dim(1) * x.dim(2));
}

Tensor one_view(Graph& g, Tensor x, int view) {
  const ggml_tensor* node = x.node();
  return ggml_view_2d(g.context(), x.node(), x.dim(0), x.dim(1), node->nb[1],
                      static_cast<std::size_t>(view) * node->nb[2]);
}

Tensor prepend_token(Graph& g, Tensor token, Tensor x) {
  return concat_tokens(g, {ggml_repeat_4d(g.context(), token.node(), x.dim(0), 1, x.dim(2), 1), x});
}

Tensor first_features(Graph& g, Tensor x, int count) {
  const std::int64_t d = x.dim(0);
  const Tensor kept = g.constant(fmt::format("first_features/{}/{}", d, count), [&](Store& store) {
    std::vector<float> values(static_cast<std::size_t>(d), 0.0f);
    std::fill_n(values.begin(), count, 1.0f);
    return store.add_constant(std::move(values), {d});
  });
  return multiply(g, x, kept);
}

Tensor one_column(Graph& g, Tensor x) { return ggml_reshape_2d(g.context(), x.node(), x.dim(0) * x.dim(1), 1); }

Tensor columns(Graph& g, Tensor x, std::int64_t d) {
  return ggml_reshape_3d(g.context(), x.node(), d, x.dim(1) * x.dim(0) / d, x.dim(2));
}

Tensor pixel_shuffle(Graph& g, Tensor x, int factor) {
  return pixel_shuffle(g, x, static_cast<int>(std::lround(std::sqrt(static_cast<double>(x.dim(1))))), factor);
}

Tensor pixel_shuffle(Graph& g, Tensor x, int n_column, int factor) {
  ggml_context* c = g.context();
  const std::int64_t d = x.dim(0), n_view = x.dim(2), n_row = x.dim(1) / n_column;
  // Patch (factor R + r, factor C + c): c is the fastest after the features, then C, r, R; C and r change places.
  ggml_tensor* split = ggml_reshape_4d(c, kernels::contiguous(g, x).node(), d * factor, n_column / factor, factor,
                                       n_row / factor * n_view);
  ggml_tensor* swapped = ggml_cont(c, ggml_permute(c, split, 0, 2, 1, 3));
  return ggml_reshape_3d(c, swapped, d * factor * factor, x.dim(1) / (factor * factor), n_view);
}

}  // namespace vla

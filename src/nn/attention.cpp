// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "nn/attention.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>

#include "kernels/attention.h"

namespace vla {
namespace {

/// [n_key, n_query], 0 where `sees(query, key)` and -infinity elsewhere.
template <class Sees>
Tensor make_mask(Graph& g, const std::string& key, int n_key, int n_query, Sees sees) {
  return g.constant(key, [&](Store& store) {
    std::vector<float> mask;
    mask.reserve(static_cast<std::size_t>(n_key) * static_cast<std::size_t>(n_query));
    for (int i = 0; i < n_query; ++i)
      for (int j = 0; j < n_key; ++j) mask.push_back(sees(i, j) ? 0.0f : -std::numeric_limits<float>::infinity());
    return store.add_constant(std::move(mask), {n_key, n_query});
  });
}

}  // namespace

Tensor pack_keys(Graph& g, Tensor k, Tensor v) {
  return kernels::has_attention(g, k.dim(0)) ? kernels::pack_keys(g, k, v) : Tensor();
}

Tensor attention(Graph& g, Tensor q, Tensor k, Tensor v, Tensor mask) { return attention(g, q, k, v, mask, {}); }

Tensor attention(Graph& g, Tensor q, Tensor k, Tensor v, Tensor mask, Tensor packed) {
  if (kernels::has_attention(g, q.dim(0))) return kernels::attention(g, q, k, v, mask, packed);
  ggml_context* c = g.context();
  const float scale = 1.0f / std::sqrt(static_cast<float>(q.dim(0)));
  ggml_tensor* query = ggml_permute(c, q.node(), 0, 2, 1, 3);                // [d_head, n_query, n_head, n_batch]
  ggml_tensor* key = ggml_permute(c, k.node(), 0, 2, 1, 3);                  // [d_head, n_key, n_head_kv, n_batch]
  ggml_tensor* value = ggml_cont(c, ggml_permute(c, v.node(), 1, 2, 0, 3));  // [n_key, d_head, n_head_kv, n_batch]
  ggml_tensor* score = ggml_mul_mat(c, key, query);                          // [n_key, n_query, n_head, n_batch]
  ggml_tensor* weight = ggml_soft_max_ext(c, score, mask.node(), scale, 0.0f);
  ggml_tensor* mixed =
      ggml_permute(c, ggml_mul_mat(c, value, weight), 0, 2, 1, 3);  // [d_head, n_head, n_query, n_batch]
  return ggml_cont_3d(c, mixed, q.dim(0) * q.dim(1), q.dim(2), q.dim(3));
}

Tensor group_mask(Graph& g, std::span<const int> group_sizes) {
  std::vector<int> group;  // of each token
  for (std::size_t i = 0; i < group_sizes.size(); ++i)
    group.insert(group.end(), static_cast<std::size_t>(group_sizes[i]), static_cast<int>(i));
  const int n = static_cast<int>(group.size());
  return make_mask(g, fmt::format("group_mask/{}", fmt::join(group_sizes, "/")), n, n, [&](int i, int j) {
    return group[static_cast<std::size_t>(j)] <= group[static_cast<std::size_t>(i)];
  });
}

Tensor causal_mask(Graph& g, int n_past, int n_query) {
  return make_mask(g, fmt::format("causal_mask/{}/{}", n_past, n_query), n_past + n_query, n_query,
                   [&](int i, int j) { return j <= n_past + i; });
}

Tensor causal_mask(Graph& g, const std::vector<bool>& seen) {
  const int n = static_cast<int>(seen.size());
  if (std::find(seen.begin(), seen.end(), false) == seen.end()) return causal_mask(g, 0, n);
  return make_mask(g, fmt::format("causal_mask/{}", fmt::join(seen, "")), n, n,
                   [&](int i, int j) { return j <= i && seen[static_cast<std::size_t>(j)]; });
}

Tensor copies_mask(Graph& g, const std::vector<int>& copies, int n_query) {
  if (std::all_of(copies.begin(), copies.end(), [](int n) { return n == 1; })) return {};
  return g.constant(fmt::format("copies_mask/{}/{}", n_query, fmt::join(copies, "/")), [&](Store& store) {
    std::vector<float> mask;
    for (int i = 0; i < n_query; ++i)
      for (const int n : copies) mask.push_back(static_cast<float>(std::log(static_cast<double>(n))));
    return store.add_constant(std::move(mask), {static_cast<std::int64_t>(copies.size()), n_query});
  });
}

Tensor split_heads(Graph& g, Tensor x, int n_head) {
  return ggml_reshape_4d(g.context(), x.node(), x.dim(0) / n_head, n_head, x.dim(1), x.dim(2));
}

Tensor merge_heads(Graph& g, Tensor x) { return ggml_reshape_2d(g.context(), x.node(), x.dim(0) * x.dim(1), x.dim(2)); }

}  // namespace vla

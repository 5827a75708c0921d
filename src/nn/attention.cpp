// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "nn/attention.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>

#include "nn/tokens.h"

namespace vla {
namespace {

/// [n_key, n_query], 0 where `sees(query, key)` and -infinity elsewhere.
template <class Sees>
Tensor make_mask(Graph& g, const std::string& key, int n_key, int n_query, Sees sees) {
  return g.constant(key, {n_key, n_query, 1, 1}, [&] {
    std::vector<float> mask;
    mask.reserve(static_cast<std::size_t>(n_key) * static_cast<std::size_t>(n_query));
    for (int i = 0; i < n_query; ++i)
      for (int j = 0; j < n_key; ++j) mask.push_back(sees(i, j) ? 0.0f : -std::numeric_limits<float>::infinity());
    return mask;
  });
}

/// The index of each token's group.
std::vector<int> groups_of(std::span<const int> group_sizes) {
  std::vector<int> group;
  for (std::size_t i = 0; i < group_sizes.size(); ++i)
    group.insert(group.end(), static_cast<std::size_t>(group_sizes[i]), static_cast<int>(i));
  return group;
}

}  // namespace

Tensor attention(Graph& g, Tensor q, const std::vector<KeyValue>& segments, Tensor mask) {
  std::vector<Tensor> in = {q};
  if (mask) in.push_back(mask);
  for (const KeyValue& segment : segments) in.insert(in.end(), {segment.key, segment.value});
  return g.add(op::Attention{static_cast<bool>(mask)}, in);
}

Tensor group_mask(Graph& g, std::span<const int> group_sizes) {
  const std::vector<int> group = groups_of(group_sizes);
  const int n = static_cast<int>(group.size());
  return make_mask(g, fmt::format("group_mask/{}", fmt::join(group_sizes, "/")), n, n, [&](int i, int j) {
    return group[static_cast<std::size_t>(j)] <= group[static_cast<std::size_t>(i)];
  });
}

Tensor apart_mask(Graph& g, std::span<const int> group_sizes) {
  const std::vector<int> group = groups_of(group_sizes);
  const int n = static_cast<int>(group.size());
  return make_mask(g, fmt::format("apart_mask/{}", fmt::join(group_sizes, "/")), n, n, [&](int i, int j) {
    return group[static_cast<std::size_t>(j)] == group[static_cast<std::size_t>(i)];
  });
}

Tensor first_mask(Graph& g, int n_seen, int n_key, int n_query) {
  return make_mask(g, fmt::format("first_mask/{}/{}/{}", n_seen, n_key, n_query), n_key, n_query,
                   [&](int, int j) { return j < n_seen; });
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
  const auto n_key = static_cast<std::int64_t>(copies.size());
  return g.constant(fmt::format("copies_mask/{}/{}", n_query, fmt::join(copies, "/")), {n_key, n_query, 1, 1}, [&] {
    std::vector<float> mask;
    for (int i = 0; i < n_query; ++i)
      for (const int n : copies) mask.push_back(static_cast<float>(std::log(static_cast<double>(n))));
    return mask;
  });
}

Tensor tanh_of(Graph& g, Tensor x) {
  constexpr int kHead = 8;  // features of a head, of which only the first is used
  const std::int64_t n = x.dim(0) * x.dim(1);
  const auto firsts = [&](const std::string& key, const std::vector<float>& numbers) {
    const Shape shape = {kHead, static_cast<std::int64_t>(numbers.size()), 1, 1};
    return g.constant(fmt::format("{}/{}", key, numbers.size()), shape, [&] {
      std::vector<float> values(numbers.size() * kHead);
      for (std::size_t i = 0; i < numbers.size(); ++i) values[i * kHead] = numbers[i];
      return values;
    });
  };
  const Tensor unit = firsts("tanh scale", std::vector<float>(static_cast<std::size_t>(n), std::sqrt(1.0f * kHead)));
  const Tensor ends = g.add(op::Reshape{}, {firsts("tanh ends", {1, -1})}, {kHead, 1, 2, 1});
  const Tensor asked = multiply(g, unit, g.add(op::Reshape{}, {x}, {1, n, 1, 1}));
  const Tensor seen = attention(g, split_heads(g, asked, 1), {{ends, ends}}, {});
  return g.add(op::Reshape{}, {slice_features(g, seen, 0, 1)}, x.shape());
}

Tensor split_heads(Graph& g, Tensor x, int n_head) {
  return g.add(op::Reshape{}, {x}, {x.dim(0) / n_head, n_head, x.dim(1), x.dim(2)});
}

Tensor merge_heads(Graph& g, Tensor x) {
  return g.add(op::Reshape{}, {x}, {x.dim(0) * x.dim(1), x.dim(2), x.dim(3), 1});
}

}  // namespace vla

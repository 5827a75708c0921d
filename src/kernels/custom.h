// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <ggml.h>

#include <algorithm>
#include <cstddef>
#include <initializer_list>
#include <new>
#include <type_traits>
#include <vector>

#include "backend/graph.h"

namespace vla::kernels {

/// The part of [0, count) that thread `ith` of `nth` works on.
struct Range {
  std::int64_t begin, end;
  Range(std::int64_t count, int ith, int nth) : begin(count * ith / nth), end(count * (ith + 1) / nth) {}
};

/// A copy of `value` that lives as long as the graph: what a node of our own needs beside its tensors.
template <class T>
T* keep(Graph& g, const T& value) {
  static_assert(std::is_trivially_destructible_v<T>);
  return new (ggml_new_buffer(g.context(), sizeof(T))) T(value);
}

/// A node of float32 that `task(node, thread, n_thread, user)` computes from the sources, which it finds as node->src.
inline Tensor custom(Graph& g, std::initializer_list<std::int64_t> shape, std::initializer_list<Tensor> sources,
                     ggml_custom_op_t task, void* user) {
  std::int64_t ne[4] = {1, 1, 1, 1};
  std::copy(shape.begin(), shape.end(), ne);
  std::vector<ggml_tensor*> nodes;
  for (Tensor source : sources)
    if (source) nodes.push_back(source.node());
  return ggml_custom_4d(g.context(), GGML_TYPE_F32, ne[0], ne[1], ne[2], ne[3], nodes.data(),
                        static_cast<int>(nodes.size()), task, GGML_N_TASKS_MAX, user);
}

inline const float* values(const ggml_tensor* tensor) { return static_cast<const float*>(tensor->data); }

/// Row i of a tensor, counted through all its dimensions; the row itself is contiguous.
inline const float* row_of(const ggml_tensor* x, std::int64_t i) {
  const std::int64_t i1 = i % x->ne[1], i2 = i / x->ne[1] % x->ne[2], i3 = i / x->ne[1] / x->ne[2];
  const auto offset = static_cast<std::size_t>(i1) * x->nb[1] + static_cast<std::size_t>(i2) * x->nb[2] +
                      static_cast<std::size_t>(i3) * x->nb[3];
  return reinterpret_cast<const float*>(static_cast<const std::byte*>(x->data) + offset);
}

}  // namespace vla::kernels

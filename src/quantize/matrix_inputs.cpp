// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "quantize/matrix_inputs.h"

#include <algorithm>

namespace vla {

bool is_view_of_channels(const Node& node) {
  if (const auto* slice = node.as<op::Slice>()) return slice->dim != 0;
  if (node.as<op::Gather>() != nullptr) return true;
  return node.as<op::Reshape>() != nullptr && node.shape[0] == node.in[0].dim(0);
}

bool is_zeros(const Node& node) {
  const auto* constant = node.as<op::Constant>();
  const auto* values = constant != nullptr ? std::get_if<std::vector<float>>(&constant->values) : nullptr;
  return values != nullptr && std::ranges::all_of(*values, [](float value) { return value == 0; });
}

void add_inputs(const Graph& graph, MatrixInputs& to) {
  for (const Node& node : graph.nodes()) {
    const auto* linear = node.as<op::Linear>();
    if (linear == nullptr || linear->weight->source == nullptr) continue;
    const Node* x = node.in[0].node();
    while (x->path.empty() && is_view_of_channels(*x)) x = x->in[0].node();
    if (!is_zeros(*x)) to[linear->weight->source->data.data()].insert(x->path);
  }
}

}  // namespace vla

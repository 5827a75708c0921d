// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "quantize/graphs.h"

#include <algorithm>

namespace vla {

Result<std::unique_ptr<Engine>> see_graphs(const std::string& bundle, const EngineOptions& options,
                                           const std::function<void(const Graph&)>& see) {
  return Engine::load(bundle, {.n_thread = options.n_thread,
                               .kernels = "float32",
                               .dry = true,
                               .all_robots = options.all_robots,
                               .see_graph = see});
}

Readers readers_of(const Graph& graph) {
  Readers readers;
  for (const Node& node : graph.nodes())
    for (const Tensor in : node.in) readers[in.node()].push_back(&node);
  return readers;
}

const Param* parameter_of(const Node& node) {
  const auto* leaf = node.as<op::Parameter>();
  return leaf != nullptr ? leaf->param : nullptr;
}

bool is_float(const Param& matrix) { return matrix.encoding.type == DType::f32 || matrix.encoding.type == DType::bf16; }

bool find_products(const Node& value, const Readers& readers, bool (*passes)(const Node&),
                   std::vector<const Node*>& products) {
  const auto found = readers.find(&value);
  if (found == readers.end()) return true;
  return std::ranges::all_of(found->second, [&](const Node* reader) {
    if (passes(*reader)) return find_products(*reader, readers, passes, products);
    const auto* linear = reader->as<op::Linear>();
    if (linear == nullptr || linear->rule != op::Rule::floats) return false;
    products.push_back(reader);
    return true;
  });
}

}  // namespace vla

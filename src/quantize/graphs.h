// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <functional>
#include <map>
#include <memory>
#include <vector>

#include "engine/engine.h"
#include "graph/graph.h"

namespace vla {

/// Loads a policy without computing anything and passes every graph to `see`: those of load, prefix and step, for
/// float32 arithmetic. The engine owns the parameters. Errors: those of Engine.
Result<std::unique_ptr<Engine>> see_graphs(const std::string& bundle, const EngineOptions& options,
                                           const std::function<void(const Graph&)>& see);

/// The nodes that read a node, in order.
using Readers = std::map<const Node*, std::vector<const Node*>>;
Readers readers_of(const Graph& graph);

/// The parameter that a node is; null for any other node.
const Param* parameter_of(const Node& node);

/// Whether a matrix's elements are floats that can be changed: f32 or bf16.
bool is_float(const Param& matrix);

/// Collects the products of floats that read a value, also through nodes that `passes` its tokens. False if anything
/// else reads it.
bool find_products(const Node& value, const Readers& readers, bool (*passes)(const Node&),
                   std::vector<const Node*>& products);

}  // namespace vla

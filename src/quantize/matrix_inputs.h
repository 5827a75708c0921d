// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <map>
#include <set>
#include <string>

#include "graph/graph.h"

namespace vla {

/// Whether a node gives some tokens of its operand, or all, with the same channels.
bool is_view_of_channels(const Node& node);

/// The paths of the values that matrices multiply, by the bytes of the matrices' tensors; an empty one is that of a
/// value without.
using MatrixInputs = std::map<const std::byte*, std::set<std::string>>;
/// Adds those of a graph.
void add_inputs(const Graph& graph, MatrixInputs& to);

}  // namespace vla

// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <map>
#include <set>
#include <string>

#include "graph/graph.h"

namespace vla {

/// Whether a node returns some or all tokens of its first operand with the same channels, in any order.
bool is_view_of_channels(const Node& node);

/// Whether a node is a constant of zeros: its product with any matrix is zero.
bool is_zeros(const Node& node);

/// The paths of the values that matrices multiply, by the address of the matrices' bytes. A value without a path has
/// the empty path; constants of zeros are left out.
using MatrixInputs = std::map<const std::byte*, std::set<std::string>>;
/// Adds the inputs of a graph's matrices.
void add_inputs(const Graph& graph, MatrixInputs& to);

}  // namespace vla

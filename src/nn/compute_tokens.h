// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "graph/graph.h"

namespace vla {

/// Tokens first to first + count - 1 of y: [d, n, n_view] -> [d, count, n_view], where nobody needs the others. What
/// led to y is recorded again for these tokens alone, back to the values that are needed whole: keys and values of
/// attention, what is stored or tapped, and results of operations that mix tokens. The rest of y is not computed.
Tensor compute_tokens(Graph& g, Tensor y, int first, int count);

}  // namespace vla

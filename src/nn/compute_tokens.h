// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "graph/graph.h"

namespace vla {

/// Computes tokens first to first + count - 1 of y only: [d, n, n_view] -> [d, count, n_view]. The operations that led
/// to y are recorded again for these tokens, back to values that are needed completely: keys and values of attention,
/// stored or tapped values, and results of operations that mix tokens. The rest of y is not computed.
Tensor compute_tokens(Graph& g, Tensor y, int first, int count);

}  // namespace vla

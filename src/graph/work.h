// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "graph/graph.h"

namespace vla {

/// What a computation asks of a machine. `flop` counts matrix and attention products alone, two for each multiply-add:
/// everything else takes time without being the work that a peak is measured in. `bytes` counts every operand and
/// result once per operation of the program, in its stored dtype, so that a fused operation asks for less.
struct Work {
  double flop = 0, bytes = 0;

  Work& operator+=(const Work& other) {
    flop += other.flop;
    bytes += other.bytes;
    return *this;
  }
};

/// The products of a node, from its shapes.
double flop_of(const Node& node);

}  // namespace vla

// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "graph/graph.h"

namespace vla {

/// A computation's load on a machine. `flop` counts matrix and attention products alone, two for each multiply-add:
/// everything else takes time without being the work that a peak is measured in. `bytes` counts every operand and
/// result once per operation of the program, in its stored dtype, so that a fused operation asks for less.
struct Work {
  double flop = 0, bytes = 0;
  double int8 = 0;     // of flop: products of int8 codes
  double weights = 0;  // of bytes: parameters, which no cache holds from run to run

  Work& operator+=(const Work& other) {
    flop += other.flop;
    bytes += other.bytes;
    int8 += other.int8;
    weights += other.weights;
    return *this;
  }
  /// The same n times.
  Work times(int n) const { return {n * flop, n * bytes, n * int8, n * weights}; }
};

/// The products of a node, from its shapes.
double flop_of(const Node& node);

}  // namespace vla

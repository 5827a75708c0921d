// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "graph/graph.h"

namespace vla {

/// The work of a computation. `flop` counts two for each multiply-add of matrix and attention products; other
/// operations are not counted, because no peak rate is measured in their units. `bytes` counts every operand and result
/// once per operation of the program, in its stored dtype, so a fused operation moves fewer.
struct Work {
  double flop = 0, bytes = 0;
  double int8 = 0;     // share of flop that multiplies int8 codes
  double weights = 0;  // share of bytes that are parameters, which no cache keeps from run to run

  Work& operator+=(const Work& other) {
    flop += other.flop;
    bytes += other.bytes;
    int8 += other.int8;
    weights += other.weights;
    return *this;
  }
  /// The work of n repetitions.
  Work times(int n) const { return {n * flop, n * bytes, n * int8, n * weights}; }
};

/// The FLOP of a node's products, from its shapes.
double flop_of(const Node& node);

}  // namespace vla

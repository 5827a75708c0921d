// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "graph/graph.h"

namespace vla {

/// The result's shape and type, if the operands fit.
struct ShapeCheck {
  bool fits;
  Shape shape = {1, 1, 1, 1};  // the result's shape
  DType type = DType::f32;
};

/// The shape rules of graph/op.h. `asked` is the requested shape where the operands do not determine it.
ShapeCheck check_shapes(const Op& op, const std::vector<Tensor>& in, const Shape& asked);

}  // namespace vla

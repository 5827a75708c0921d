// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <type_traits>

#include "lower/lowering.h"

namespace vla::lower {

/// The operations unfold, max_pool and depthwise.
struct WindowOp {
  const Node* node;
  op::Window window;
  bool takes_largest;  // takes the maximum of the covered pixels; else copies them, or sums them with weights
  ValueId x, weight = kNone, bias = kNone;

  Operands operands() { return {{x, Needs::contiguous}, {weight, Needs::contiguous}, {bias, Needs::contiguous}}; }
  std::string text() const { return op_name(node->op); }
  double flop() const { return 0; }
};

template <class Op, class = decltype(Op::window)>
WindowOp lowered(const Lowering&, const Node& node, const Op& op) {
  return {.node = &node,
          .window = op.window,
          .takes_largest = std::is_same_v<Op, op::MaxPool>,
          .x = operand(node, 0),
          .weight = operand(node, 1),
          .bias = operand(node, 2)};
}

}  // namespace vla::lower

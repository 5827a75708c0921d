// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <type_traits>
#include <variant>

#include "lower/lowering.h"

namespace vla::lower {

/// An operation on one row at a time.
struct RowOp {
  const Node* node;
  std::variant<op::Norm, op::Rope, op::Activate, op::Add, op::Multiply, op::Scale> what;
  ValueId x, w = kNone, b = kNone;
  Needs norm_needs;  // the need of x, if this is a norm

  Operands operands() {
    const bool is_norm = std::holds_alternative<op::Norm>(what), is_rope = std::holds_alternative<op::Rope>(what);
    return {{x, is_norm ? norm_needs : Needs::unit_rows},
            {w, is_norm || is_rope ? Needs::contiguous : Needs::unit_rows},
            {b, Needs::contiguous}};
  }
  std::string text() const { return op_name(node->op) + (" " + path_of(*node)); }
  double flop() const { return 0; }
};

template <class Op, class = std::enable_if_t<std::is_constructible_v<decltype(RowOp::what), const Op&>>>
RowOp lowered(const Lowering& l, const Node& node, const Op& op) {
  return {.node = &node,
          .what = op,
          .x = operand(node, 0),
          .w = operand(node, 1),
          .b = operand(node, 2),
          .norm_needs = l.target.norm_needs};
}

}  // namespace vla::lower

// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lower/lowering.h"

namespace vla::lower {

struct ChannelOp {
  const Node* node;
  ValueId q, k, v;
  int n_group;

  Operands operands() { return {{q, Needs::even_rows}, {k, Needs::even_rows}, {v, Needs::even_rows}}; }
  std::string text() const { return std::string(op_name(node->op)) + " of " + std::to_string(n_group) + " groups"; }
  double flop() const { return flop_of(*node); }
};

inline ChannelOp lowered(const Lowering&, const Node& node, const op::ChannelAttention& op) {
  return {&node, operand(node, 0), operand(node, 1), operand(node, 2), op.n_group};
}

}  // namespace vla::lower

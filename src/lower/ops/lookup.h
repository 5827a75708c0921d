// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lower/lowering.h"

namespace vla::lower {

/// The operations embedding and gather.
struct LookupOp {
  const Node* node;
  ValueId ids, table = kNone;  // kNone: the table is the embedding's parameter

  Operands operands() { return {{ids, Needs::contiguous}, {table, Needs::contiguous}}; }
  std::string text() const { return op_name(node->op) + (" " + path_of(*node)); }
  double flop() const { return 0; }
};

inline LookupOp lowered(const Lowering&, const Node& node, const op::Embedding&) { return {&node, operand(node, 0)}; }
inline LookupOp lowered(const Lowering&, const Node& node, const op::Gather&) {
  return {&node, operand(node, 1), operand(node, 0)};
}

}  // namespace vla::lower

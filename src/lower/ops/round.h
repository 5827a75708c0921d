// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lower/lowering.h"

namespace vla::lower {

/// Converts x, or its norm, to the type that products read (codes, bf16 or float32), once for all products of one x.
struct RoundOp {
  const Node* product;  // the first product that reads it
  ValueId x;
  const Node* norm;  // the norm that is applied to x first, or null
  ValueId weight, bias;
  const char* verb;  // the operation's name in a printed program

  Operands operands() { return {{x, Needs::even_rows}, {weight, Needs::contiguous}, {bias, Needs::contiguous}}; }
  std::string text() const { return std::string(norm != nullptr ? "norm, " : "") + verb; }
  double flop() const { return 0; }
};

}  // namespace vla::lower

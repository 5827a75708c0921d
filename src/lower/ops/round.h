// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lower/lowering.h"

namespace vla::lower {

/// x, or its norm, as products read it: as codes, as bf16 or as float32. Once for all products of one x.
struct RoundOp {
  const Node* product;  // the first of them
  ValueId x;
  const Node* norm;  // x is what this node normalizes, if any
  ValueId weight, bias;
  const char* verb;  // of a printed program

  Operands operands() { return {{x, Needs::even_rows}, {weight, Needs::contiguous}, {bias, Needs::contiguous}}; }
  std::string text() const { return std::string(norm != nullptr ? "norm, " : "") + verb; }
  double flop() const { return 0; }
};

}  // namespace vla::lower

// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lower/lowering.h"

namespace vla::lower {

/// activation(W x + b) * factor + residual, optionally with a final ReLU; or up to three products of one x; or the gate
/// and up products of a gated MLP.
struct LinearOp {
  std::vector<const Node*> linears;
  ValueId x;
  const Node* norm = nullptr;    // the norm that is applied to x first
  const Node* unfold = nullptr;  // the window that is moved over x
  ValueId norm_weight = kNone, norm_bias = kNone;
  Activation activation = Activation::none;
  bool gated = false;
  bool ends_in_relu = false;
  ValueId factor = kNone, residual = kNone;

  Operands operands() {
    return {{x, unfold != nullptr ? Needs::contiguous : Needs::even_rows},
            {norm_weight, Needs::contiguous},
            {norm_bias, Needs::contiguous},
            {factor, Needs::contiguous},
            {residual, Needs::contiguous}};
  }
  std::string text() const {
    std::string what = norm != nullptr ? "norm, linear " : unfold != nullptr ? "unfold, linear " : "linear ";
    for (std::size_t i = 0; i < linears.size(); ++i) what += (i > 0 ? " | " : "") + path_of(*linears[i]);
    if (activation != Activation::none) what += std::string(", ") + activation_name(activation);
    if (gated) what += ", gate";
    if (factor != kNone) what += ", factor";
    if (residual != kNone) what += ", residual";
    if (ends_in_relu) what += ", relu";
    return what;
  }
  double flop() const {
    double all = 0;
    for (const Node* node : linears) all += flop_of(*node);
    return all;
  }
};

}  // namespace vla::lower

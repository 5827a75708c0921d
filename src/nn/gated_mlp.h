// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "nn/linear.h"

namespace vla {

/// down(gelu_tanh(gate(x)) * up(x)), without biases. x [d_model, n] -> the same shape. Source: transformers GemmaMLP.
class GeluGatedMlp {
 public:
  GeluGatedMlp(const Scope& s, int d_model, int d_ff);
  Tensor operator()(Graph& g, Tensor x) const;

 private:
  Linear gate_, up_, down_;
};

}  // namespace vla

// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "nn/linear.h"

namespace vla {

/// down(gelu_tanh(up(x))), with biases. x [d_model, n, ...] -> the same shape. Source: transformers SiglipMLP.
class GeluMlp {
 public:
  GeluMlp(const Scope& s, int d_model, int d_ff);
  Tensor operator()(Graph& g, Tensor x) const;
  /// residual + the same.
  Tensor added_to(Graph& g, Tensor residual, Tensor x) const;

 private:
  Linear up_, down_;
};

/// down(silu(gate(x)) * up(x)), without biases. x [d_model, n] -> the same shape. Source: transformers LlamaMLP.
class SiluGatedMlp {
 public:
  SiluGatedMlp(const Scope& s, int d_model, int d_ff);
  Tensor operator()(Graph& g, Tensor x) const;
  /// residual + the same.
  Tensor added_to(Graph& g, Tensor residual, Tensor x) const;

 private:
  Linear gate_, up_, down_;
};

/// x / (1 + exp(-x)). Source: torch silu.
Tensor silu(Graph& g, Tensor x);

}  // namespace vla

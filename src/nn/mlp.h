// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "nn/linear.h"

namespace vla {

/// down(activation(up(x))), with biases. x [d_model, n, ...] -> the same shape.
/// Sources: transformers SiglipMLP (gelu_tanh), InternVLVisionMLP (gelu_erf).
class Mlp {
 public:
  Mlp(const Scope& s, int d_model, int d_ff, Activation activation);
  Tensor operator()(Graph& g, Tensor x) const;
  /// residual + the same.
  Tensor added_to(Graph& g, Tensor residual, Tensor x) const;

 private:
  Linear up_, down_;
  Activation activation_;
};

/// down(activation(gate(x)) * up(x)), without biases. x [d_model, n] -> the same shape.
/// Sources: transformers LlamaMLP (silu), GemmaMLP (gelu_tanh).
class GatedMlp {
 public:
  GatedMlp(const Scope& s, int d_model, int d_ff, Activation activation);
  Tensor operator()(Graph& g, Tensor x) const;
  /// residual + the same.
  Tensor added_to(Graph& g, Tensor residual, Tensor x) const;

 private:
  Linear gate_, up_, down_;
  Activation activation_;
};

/// x / (1 + exp(-x)). Source: torch silu.
Tensor silu(Graph& g, Tensor x);

}  // namespace vla

// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "nn/linear.h"
#include "nn/tokens.h"

namespace vla {

/// down(activation(up(x))), with biases. x [d_model, n, ...] -> the same shape.
/// Sources: transformers SiglipMLP (gelu_tanh), InternVLVisionMLP (gelu_erf).
class Mlp {
 public:
  Mlp(const Scope& s, int d_model, int d_ff, Activation activation)
      : up_(s / "ffn_up", d_model, d_ff, Bias::yes),
        down_(s / "ffn_down", d_ff, d_model, Bias::yes),
        activation_(activation) {}
  Tensor operator()(Graph& g, Tensor x) const { return down_(g, activate(g, up_(g, x), activation_)); }

 private:
  Linear up_, down_;
  Activation activation_;
};

/// down(activation(gate(x)) * up(x)), without biases. x [d_model, n] -> the same shape.
/// Sources: transformers LlamaMLP (silu), GemmaMLP (gelu_tanh).
class GatedMlp {
 public:
  GatedMlp(const Scope& s, int d_model, int d_ff, Activation activation)
      : gate_(s / "ffn_gate", d_model, d_ff, Bias::no),
        up_(s / "ffn_up", d_model, d_ff, Bias::no),
        down_(s / "ffn_down", d_ff, d_model, Bias::no),
        activation_(activation) {}
  Tensor operator()(Graph& g, Tensor x) const {
    return down_(g, multiply(g, activate(g, gate_(g, x), activation_), up_(g, x)));
  }

 private:
  Linear gate_, up_, down_;
  Activation activation_;
};

}  // namespace vla

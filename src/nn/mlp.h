// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>

#include "nn/linear.h"
#include "nn/norm.h"
#include "nn/tokens.h"

namespace vla {

/// down(activation(up(x))), with biases. x [d_model, n, ...] -> the same shape.
/// Sources: transformers SiglipMLP (gelu_tanh), InternVLVisionMLP (gelu_erf).
class Mlp {
 public:
  Mlp(const Scope& s, int d_model, int d_ff, Activation activation, Rule rule = Rule::floats)
      : hidden_path_((s / "ffn_hidden").path()),
        up_(s / "ffn_up", d_model, d_ff, Bias::yes, rule),
        down_(s / "ffn_down", d_ff, d_model, Bias::yes, rule),
        activation_(activation) {}
  Tensor operator()(Graph& g, Tensor x) const {
    return down_(g, g.name(hidden_path_, activate(g, up_(g, x), activation_)));
  }

 private:
  std::string hidden_path_;
  Linear up_, down_;
  Activation activation_;
};

/// down(activation(gate(x)) * up(x)), without biases. If `sub_norm_eps` is given, an RMS norm `ffn_sub_norm` precedes
/// `down`. x [d_model, n] -> the same shape.
/// Sources: transformers LlamaMLP (silu), GemmaMLP (gelu_tanh); BitVLA modeling_bitnet.py BitNetMLP (relu_squared).
class GatedMlp {
 public:
  GatedMlp(const Scope& s, int d_model, int d_ff, Activation activation, Rule rule = Rule::floats,
           std::optional<float> sub_norm_eps = {})
      : hidden_path_((s / "ffn_hidden").path()),
        gate_(s / "ffn_gate", d_model, d_ff, Bias::no, rule),
        up_(s / "ffn_up", d_model, d_ff, Bias::no, rule),
        down_(s / "ffn_down", d_ff, d_model, Bias::no, rule),
        activation_(activation) {
    if (sub_norm_eps) sub_norm_.emplace(s / "ffn_sub_norm", d_ff, *sub_norm_eps);
  }
  Tensor operator()(Graph& g, Tensor x) const {
    const Tensor up = up_(g, x);  // evaluated first: compilers differ in the order of arguments
    const Tensor h = g.name(hidden_path_, multiply(g, activate(g, gate_(g, x), activation_), up));
    return down_(g, sub_norm_ ? (*sub_norm_)(g, h) : h);
  }

 private:
  std::string hidden_path_;
  Linear gate_, up_, down_;
  std::optional<RmsNorm> sub_norm_;
  Activation activation_;
};

}  // namespace vla

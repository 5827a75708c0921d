// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "nn/mlp.h"

#include "kernels/elementwise.h"

namespace vla {

Mlp::Mlp(const Scope& s, int d_model, int d_ff, Activation activation)
    : up_(s / "ffn_up", d_model, d_ff, Bias::yes),
      down_(s / "ffn_down", d_ff, d_model, Bias::yes),
      activation_(activation) {}

Tensor Mlp::operator()(Graph& g, Tensor x) const { return down_(g, up_.activated(g, x, activation_)); }

Tensor Mlp::added_to(Graph& g, Tensor residual, Tensor x) const {
  return down_.added_to(g, residual, up_.activated(g, x, activation_));
}

GatedMlp::GatedMlp(const Scope& s, int d_model, int d_ff, Activation activation)
    : gate_(s / "ffn_gate", d_model, d_ff, Bias::no),
      up_(s / "ffn_up", d_model, d_ff, Bias::no),
      down_(s / "ffn_down", d_ff, d_model, Bias::no),
      activation_(activation) {}

Tensor GatedMlp::operator()(Graph& g, Tensor x) const { return down_(g, Linear::gated(g, gate_, up_, x, activation_)); }

Tensor GatedMlp::added_to(Graph& g, Tensor residual, Tensor x) const {
  return down_.added_to(g, residual, Linear::gated(g, gate_, up_, x, activation_));
}

Tensor silu(Graph& g, Tensor x) { return ggml_silu(g.context(), x.node()); }

}  // namespace vla

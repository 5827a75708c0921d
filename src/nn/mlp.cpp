// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "nn/mlp.h"

#include "kernels/elementwise.h"

namespace vla {

GeluMlp::GeluMlp(const Scope& s, int d_model, int d_ff)
    : up_(s / "ffn_up", d_model, d_ff, Bias::yes), down_(s / "ffn_down", d_ff, d_model, Bias::yes) {}

Tensor GeluMlp::operator()(Graph& g, Tensor x) const { return down_(g, up_.activated(g, x, Activation::gelu_tanh)); }

Tensor GeluMlp::added_to(Graph& g, Tensor residual, Tensor x) const {
  return down_.added_to(g, residual, up_.activated(g, x, Activation::gelu_tanh));
}

SiluGatedMlp::SiluGatedMlp(const Scope& s, int d_model, int d_ff)
    : gate_(s / "ffn_gate", d_model, d_ff, Bias::no),
      up_(s / "ffn_up", d_model, d_ff, Bias::no),
      down_(s / "ffn_down", d_ff, d_model, Bias::no) {}

Tensor SiluGatedMlp::operator()(Graph& g, Tensor x) const {
  return down_(g, Linear::gated(g, gate_, up_, x, Activation::silu));
}

Tensor SiluGatedMlp::added_to(Graph& g, Tensor residual, Tensor x) const {
  return down_.added_to(g, residual, Linear::gated(g, gate_, up_, x, Activation::silu));
}

Tensor silu(Graph& g, Tensor x) { return ggml_silu(g.context(), x.node()); }

}  // namespace vla

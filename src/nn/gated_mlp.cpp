// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "nn/gated_mlp.h"

#include "kernels/elementwise.h"

namespace vla {

GeluGatedMlp::GeluGatedMlp(const Scope& s, int d_model, int d_ff)
    : gate_(s / "ffn_gate", d_model, d_ff, Bias::no),
      up_(s / "ffn_up", d_model, d_ff, Bias::no),
      down_(s / "ffn_down", d_ff, d_model, Bias::no) {}

Tensor GeluGatedMlp::operator()(Graph& g, Tensor x) const {
  const Tensor gate = kernels::gelu_tanh(g, gate_(g, x));
  return down_(g, Tensor(ggml_mul(g.context(), gate.node(), up_(g, x).node())));
}

}  // namespace vla

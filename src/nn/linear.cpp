// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "nn/linear.h"

namespace vla {

Linear::Linear(const Scope& s, int d_in, int d_out, Bias bias)
    : Module(s),
      weight_(s.matrix("weight", d_in, d_out)),
      bias_(bias == Bias::yes ? s.vector("bias", d_out) : nullptr) {}

Tensor Linear::forward(Graph& g, Tensor x) const {
  ggml_tensor* y = ggml_mul_mat(g.context(), g.weight(weight_).node(), x.node());
  return bias_ != nullptr ? ggml_add(g.context(), y, g.weight(bias_).node()) : y;
}

}  // namespace vla

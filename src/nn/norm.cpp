// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "nn/norm.h"

namespace vla {

LayerNorm::LayerNorm(const Scope& s, int d, float eps)
    : Module(s), weight_(s.vector("weight", d)), bias_(s.vector("bias", d)), eps_(eps) {}

Tensor LayerNorm::forward(Graph& g, Tensor x) const {
  ggml_context* c = g.context();
  ggml_tensor* scaled = ggml_mul(c, ggml_norm(c, x.node(), eps_), g.weight(weight_).node());
  return ggml_add(c, scaled, g.weight(bias_).node());
}

RmsNorm::RmsNorm(const Scope& s, int d, float eps) : Module(s), weight_(s.vector("weight", d)), eps_(eps) {}

Tensor RmsNorm::forward(Graph& g, Tensor x) const {
  return ggml_mul(g.context(), ggml_rms_norm(g.context(), x.node(), eps_), g.weight(weight_).node());
}

}  // namespace vla

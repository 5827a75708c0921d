// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "nn/norm.h"

#include "kernels/norm.h"
#include "nn/tokens.h"

namespace vla {

LayerNorm::LayerNorm(const Scope& s, int d, float eps)
    : Module(s), weight_(s.vector("weight", d)), bias_(s.vector("bias", d)), eps_(eps) {}

Tensor LayerNorm::forward(Graph& g, Tensor x) const {
  return kernels::layer_norm(g, x, g.weight(weight_), g.weight(bias_), eps_);
}

RmsNorm::RmsNorm(const Scope& s, int d, float eps) : Module(s), weight_(s.vector("weight", d)), eps_(eps) {}

Tensor RmsNorm::forward(Graph& g, Tensor x) const { return kernels::rms_norm(g, x, g.weight(weight_), {}, eps_); }

Tensor layer_norm(Graph& g, Tensor x, float eps) {
  return kernels::layer_norm(g, x, filled(g, 1, x.dim(0), 1), filled(g, 0, x.dim(0), 1), eps);
}

}  // namespace vla

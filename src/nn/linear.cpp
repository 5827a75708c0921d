// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "nn/linear.h"

namespace vla {
Linear::Linear(const Scope& s, int d_in, int d_out, Bias bias)
    : Module(s), term_{s.matrix("weight", d_in, d_out), bias == Bias::yes ? s.vector("bias", d_out) : nullptr} {}

Tensor Linear::forward(Graph& g, Tensor x) const { return kernels::linear(g, term_, x); }

Tensor Linear::activated(Graph& g, Tensor x, Activation activation) const {
  if (g.keeps(path())) return kernels::activate(g, activation, (*this)(g, x));
  return kernels::linear(g, term_, x, activation, {}, kernels::Readers::products);
}

Tensor Linear::added_to(Graph& g, Tensor residual, Tensor x) const {
  if (g.keeps(path())) return ggml_add(g.context(), residual.node(), (*this)(g, x).node());
  return kernels::linear(g, term_, x, Activation::none, residual);
}

Tensor Linear::gated(Graph& g, const Linear& gate, const Linear& up, Tensor x, Activation activation) {
  if (g.keeps(gate.path()) || g.keeps(up.path()))
    return ggml_mul(g.context(), kernels::activate(g, activation, gate(g, x)).node(), up(g, x).node());
  return kernels::gated_linear(g, gate.term_, up.term_, x, activation, kernels::Readers::products);
}

std::vector<Tensor> Linear::group(Graph& g, std::initializer_list<const Linear*> layers, Tensor x) {
  std::vector<kernels::LinearTerm> terms;
  for (const Linear* layer : layers) terms.push_back(layer->term_);
  std::vector<Tensor> results = kernels::linear_group(g, terms, x);
  auto result = results.begin();
  for (const Linear* layer : layers) g.name(layer->path(), *result++);
  return results;
}

}  // namespace vla

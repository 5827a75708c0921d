// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "nn/module.h"

namespace vla {

/// (x - mean) / sqrt(variance + eps) * weight + bias, over the first dimension. x [d, n, ...] -> the same shape.
/// Source: torch.nn.LayerNorm.
class LayerNorm : public Module<LayerNorm> {
 public:
  LayerNorm(const Scope& s, int d, float eps)
      : Module(s), weight_(s.vector("weight", d)), bias_(s.vector("bias", d)), eps_(eps) {}
  Tensor forward(Graph& g, Tensor x) const {
    return g.add(op::Norm{op::NormKind::layer, eps_}, {x, g.parameter(weight_), g.parameter(bias_)});
  }

 private:
  const Param* weight_;
  const Param* bias_;
  float eps_;
};

/// x / sqrt(mean(x^2) + eps) * weight, over the first dimension. x [d, n, ...] -> the same shape.
/// Source: transformers modeling_llama.py LlamaRMSNorm (the weight is not 1 + w).
class RmsNorm : public Module<RmsNorm> {
 public:
  RmsNorm(const Scope& s, int d, float eps) : Module(s), weight_(s.vector("weight", d)), eps_(eps) {}
  Tensor forward(Graph& g, Tensor x) const {
    return g.add(op::Norm{op::NormKind::rms, eps_}, {x, g.parameter(weight_)});
  }

 private:
  const Param* weight_;
  float eps_;
};

/// (x - mean) / sqrt(variance + eps), over the first dimension. x [d, n, ...] -> the same shape.
/// Source: torch.nn.LayerNorm without affine weights.
inline Tensor layer_norm(Graph& g, Tensor x, float eps) { return g.add(op::Norm{op::NormKind::layer, eps}, {x}); }

}  // namespace vla

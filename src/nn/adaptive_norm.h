// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "nn/linear.h"
#include "nn/tokens.h"

namespace vla {

/// RMS norm whose scale and shift, and the gate of the residual that follows, are linear in a condition.
/// Source: lerobot policies/pi_gemma.py PiGemmaRMSNorm.
class AdaRmsNorm : public Module<AdaRmsNorm> {
 public:
  AdaRmsNorm(const Scope& s, int d, int d_condition, float eps);

  /// Load rate, one column per condition: [d_condition, n] -> [3 d, n], the factors (1 + scale), shifts and gates.
  Tensor modulation(Graph& g, Tensor condition) const;
  /// x / sqrt(mean(x^2) + eps) * (1 + scale) + shift. x [d, n], modulation [3 d, 1] -> the shape of x.
  Tensor forward(Graph& g, Tensor x, Tensor modulation) const;
  /// The gate of a modulation [3 d, 1]: [d, 1].
  Tensor gate(Graph& g, Tensor modulation) const;

 private:
  int d_;
  float eps_;
  Linear dense_;
};

/// LayerNorm without affine weights. Its scale and shift are linear in a condition; their matrix has the norm's own
/// path. Sources: lerobot policies/groot/action_head/cross_attention_dit.py AdaLayerNorm (scale_shift), DiT.forward
/// (shift_scale).
class AdaLayerNorm {
 public:
  /// Whether scales or shifts are the first `d` rows of the matrix.
  enum class Order { scale_shift, shift_scale };
  AdaLayerNorm(const Scope& s, int d, float eps, Order order);

  /// Load rate, one column per condition: [d, n] -> [2 d, n], with factors (1 + scale) in place of scales.
  Tensor modulation(Graph& g, Tensor condition) const;
  /// (x - mean) / sqrt(variance + eps) * (1 + scale) + shift. x [d, n], modulation [2 d, 1] -> the shape of x.
  Tensor forward(Graph& g, Tensor x, Tensor modulation) const;

 private:
  int d_, first_scale_;
  float eps_;
  Linear dense_;
};

/// x + y * gate. x and y [d, n, ...], gate [d] for every token.
/// Sources: lerobot policies/pi_gemma.py _gated_residual; transformers modeling_internvl.py (LayerScale).
Tensor gated_add(Graph& g, Tensor x, Tensor y, Tensor gate);

}  // namespace vla

// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <initializer_list>

#include "kernels/linear.h"
#include "nn/module.h"

namespace vla {

enum class Bias { no, yes };
using kernels::Activation;

/// y = W x + b. x [d_in, n, ...] -> [d_out, n, ...]. Source: torch.nn.Linear.
///
/// The further forms compute what follows the product in the same node, so that it is never written and read again.
/// Where the module's own result is wanted as a tap, it is computed by itself.
class Linear : public Module<Linear> {
 public:
  Linear(const Scope& s, int d_in, int d_out, Bias bias);
  Tensor forward(Graph& g, Tensor x) const;

  /// activation(W x + b), for no one but another Linear: it may be rounded as that would round it.
  Tensor activated(Graph& g, Tensor x, Activation activation) const;
  /// residual + W x + b
  Tensor added_to(Graph& g, Tensor residual, Tensor x) const;

  /// activation(gate(x)) * up(x), likewise.
  static Tensor gated(Graph& g, const Linear& gate, const Linear& up, Tensor x, Activation activation);
  /// Up to three layers of the same x, each result [d_out, n, ...] and contiguous.
  static std::vector<Tensor> group(Graph& g, std::initializer_list<const Linear*> layers, Tensor x);

 private:
  kernels::LinearTerm term_;
};

}  // namespace vla

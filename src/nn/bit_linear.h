// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "nn/linear.h"

namespace vla {

/// A linear layer with ternary weights and int8 activations (op::Linear with a scale). x [d_in, n, ...] -> [d_out, n,
/// ...]. Source: BitVLA modeling_bitnet.py BitLinear.
class BitLinear : public Module<BitLinear> {
 public:
  BitLinear(const Scope& s, int d_in, int d_out, Bias bias)
      : Module(s),
        weight_(s.ternary("weight", d_in, d_out)),
        scale_(s.vector("scale", 1)),
        bias_(bias == Bias::yes ? s.vector("bias", d_out) : nullptr) {}
  Tensor forward(Graph& g, Tensor x) const { return g.add(op::Linear{weight_, bias_, scale_}, {x}); }

 private:
  const Param *weight_, *scale_, *bias_;
};

}  // namespace vla

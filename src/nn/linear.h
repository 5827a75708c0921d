// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "nn/module.h"

namespace vla {

enum class Bias { no, yes };

/// What a product multiplies by: floats, or -1, 0 and 1 times `<path>.scale`, with activations of 8 bits.
enum class Weights { floats, ternary };

/// y = W x + b. x [d_in, n, ...] -> [d_out, n, ...]. Sources: torch.nn.Linear; BitVLA modeling_bitnet.py BitLinear.
class Linear : public Module<Linear> {
 public:
  Linear(const Scope& s, int d_in, int d_out, Bias bias, Weights weights = Weights::floats)
      : Module(s),
        weight_(weights == Weights::ternary ? s.ternary("weight", d_in, d_out) : s.matrix("weight", d_in, d_out)),
        scale_(weights == Weights::ternary ? s.vector("scale", 1) : nullptr),
        bias_(bias == Bias::yes ? s.vector("bias", d_out) : nullptr) {}
  Tensor forward(Graph& g, Tensor x) const { return g.add(op::Linear{weight_, bias_, scale_}, {x}); }

 private:
  const Param *weight_, *scale_, *bias_;
};

}  // namespace vla

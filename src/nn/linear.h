// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "nn/module.h"

namespace vla {

enum class Bias { no, yes };

/// y = W x + b. x [d_in, n, ...] -> [d_out, n, ...]. Source: torch.nn.Linear.
class Linear : public Module<Linear> {
 public:
  Linear(const Scope& s, int d_in, int d_out, Bias bias)
      : Module(s),
        weight_(s.matrix("weight", d_in, d_out)),
        bias_(bias == Bias::yes ? s.vector("bias", d_out) : nullptr) {}
  Tensor forward(Graph& g, Tensor x) const { return g.add(op::Linear{weight_, bias_}, {x}); }

 private:
  const Param* weight_;
  const Param* bias_;
};

}  // namespace vla

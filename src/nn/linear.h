// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "nn/module.h"

namespace vla {

enum class Bias { no, yes };

using op::Rule;

/// y = W x + b. x [d_in, n, ...] -> [d_out, n, ...]. Sources: torch.nn.Linear; BitVLA modeling_bitnet.py BitLinear.
class Linear : public Module<Linear> {
 public:
  Linear(const Scope& s, int d_in, int d_out, Bias bias, Rule rule = Rule::floats)
      : Module(s),
        rule_(rule),
        weight_(rule == Rule::int8_rows ? s.ternary("weight", d_in, d_out) : s.matrix("weight", d_in, d_out)),
        bias_(bias == Bias::yes ? s.vector("bias", d_out) : nullptr) {}
  Tensor forward(Graph& g, Tensor x) const { return g.add(op::Linear{weight_, bias_, rule_}, {x}); }

 private:
  Rule rule_;
  const Param *weight_, *bias_;
};

}  // namespace vla

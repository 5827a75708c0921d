// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "nn/module.h"

namespace vla {

enum class Bias { no, yes };

/// y = W x + b. x [d_in, n, ...] -> [d_out, n, ...]. Source: torch.nn.Linear.
class Linear : public Module<Linear> {
 public:
  Linear(const Scope& s, int d_in, int d_out, Bias bias);
  Tensor forward(Graph& g, Tensor x) const;

 private:
  const Param* weight_;
  const Param* bias_;
};

}  // namespace vla

// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>

#include "nn/linear.h"
#include "nn/tokens.h"

namespace vla {

/// Projects numbers to tokens of a language model, by two layers: `<name>_in` and `<name>_out`. Source: openvla-oft
/// prismatic/models/projectors.py (ProprioProjector, NoisyActionProjector).
class TokenProjector {
 public:
  TokenProjector(const Scope& s, const std::string& name, int d_in, int d_model)
      : in_(s / (name + "_in"), d_in, d_model, Bias::yes), out_(s / (name + "_out"), d_model, d_model, Bias::yes) {}
  /// x [d_in, n] -> [d_model, n].
  Tensor operator()(Graph& g, Tensor x) const { return out_(g, activate(g, in_(g, x), Activation::gelu_erf)); }

 private:
  Linear in_, out_;
};

}  // namespace vla

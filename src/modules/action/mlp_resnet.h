// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vector>

#include "nn/linear.h"
#include "nn/norm.h"

namespace vla {

/// x + relu(linear(norm(x))). x [d, n] -> the same shape.
class MlpResNetBlock : public Module<MlpResNetBlock> {
 public:
  MlpResNetBlock(const Scope& s, int d, float eps)
      : Module(s), norm_(s / "norm", d, eps), linear_(s / "linear", d, d, Bias::yes) {}
  Tensor forward(Graph& g, Tensor x) const;

 private:
  LayerNorm norm_;
  Linear linear_;
};

/// An action head of one pass over rows of a language model's features, without time or noise. Rows of a chunk do not
/// interact. Source: BitVLA openvla-oft prismatic/models/action_heads.py MLPResNet.
class MlpResNet {
 public:
  MlpResNet(const Scope& s, int d_in, int d_hidden, int d_out);
  /// x [d_in, n] -> [d_out, n].
  Tensor operator()(Graph& g, Tensor x) const;

 private:
  LayerNorm in_norm_;
  Linear in_;
  std::vector<MlpResNetBlock> blocks_;
  LayerNorm out_norm_;
  Linear out_;
};

}  // namespace vla

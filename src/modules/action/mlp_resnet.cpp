// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/action/mlp_resnet.h"

#include "nn/tokens.h"

namespace vla {

Tensor MlpResNetBlock::forward(Graph& g, Tensor x) const {
  return add(g, x, activate(g, linear_(g, norm_(g, x)), Activation::relu));
}

MlpResNet::MlpResNet(const Scope& s, int d_in, int d_hidden, int d_out)
    : in_norm_(s / "in_norm", d_in, s.number("norm_eps", kNormEps)),
      in_(s / "in", d_in, d_hidden, Bias::yes),
      out_norm_(s / "out_norm", d_hidden, s.number("norm_eps", kNormEps)),
      out_(s / "out", d_hidden, d_out, Bias::yes) {
  const int n_layer = s.n_layer("n_layer");
  for (int i = 0; i < n_layer; ++i) blocks_.emplace_back(s / "blk" / i, d_hidden, s.number("norm_eps", kNormEps));
}

Tensor MlpResNet::operator()(Graph& g, Tensor x) const {
  Tensor h = activate(g, in_(g, in_norm_(g, x)), Activation::relu);
  for (const MlpResNetBlock& block : blocks_) h = block(g, h);
  return out_(g, out_norm_(g, h));
}

}  // namespace vla

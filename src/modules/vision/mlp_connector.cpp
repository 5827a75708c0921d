// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/vision/mlp_connector.h"

#include <fmt/format.h>

#include "nn/tokens.h"

namespace vla {

MlpConnector::MlpConnector(const Scope& s, int d_vision, int d_model, int n_row, int n_column)
    : Module(s),
      factor_(s.dim("factor", 64)),
      n_column_(n_column),
      n_token_((n_row / factor_) * (n_column / factor_)),
      norm_(s / "norm", d_vision * factor_ * factor_, s.number("norm_eps", kNormEps)),
      up_(s / "up", d_vision * factor_ * factor_, d_model, Bias::yes),
      down_(s / "down", d_model, d_model, Bias::yes) {
  s.require(n_row % factor_ == 0 && n_column % factor_ == 0, "factor",
            fmt::format("a divisor of the {} x {} patches of a view", n_row, n_column), std::to_string(factor_));
}

Tensor MlpConnector::forward(Graph& g, Tensor x) const {
  const Tensor h = norm_(g, pixel_shuffle(g, x, n_column_, factor_));
  return down_(g, activate(g, up_(g, h), Activation::gelu_erf));
}

}  // namespace vla

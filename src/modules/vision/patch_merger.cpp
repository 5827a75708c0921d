// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/vision/patch_merger.h"

#include "nn/tokens.h"

namespace vla {

PatchMerger::PatchMerger(const Scope& s, Norm norm, int d_vision, int count, int d_model, float eps)
    : Module(s),
      kind_(norm),
      d_token_(d_vision * count),
      norm_(s / "norm", norm == Norm::patch ? d_vision : d_token_, eps),
      up_(s / "up", d_token_, d_token_, Bias::yes),
      down_(s / "down", d_token_, d_model, Bias::yes) {}

Tensor PatchMerger::forward(Graph& g, Tensor x) const {
  const Tensor token =
      kind_ == Norm::patch ? reshape_width(g, norm_(g, x), d_token_) : norm_(g, reshape_width(g, x, d_token_));
  return down_.forward(g, activate(g, up_(g, token), Activation::gelu_erf));
}

}  // namespace vla

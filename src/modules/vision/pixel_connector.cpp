// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/vision/pixel_connector.h"

#include <fmt/format.h>

#include "nn/tokens.h"

namespace vla {

PixelConnector::PixelConnector(const Scope& s, int d_vision, int d_model)
    : Module(s), factor_(s.dim("factor", 64)), project_(s, d_vision * factor_ * factor_, d_model, Bias::no) {}

Tensor PixelConnector::forward(Graph& g, Tensor x) const { return project_.forward(g, pixel_shuffle(g, x, factor_)); }

Status PixelConnector::check(int side) const {
  if (side % factor_ == 0) return {};
  return Error{Code::unsupported, "connector.factor", fmt::format("a divisor of the {0} x {0} patches of a view", side),
               std::to_string(factor_)};
}

}  // namespace vla

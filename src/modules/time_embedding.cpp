// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/time_embedding.h"

#include <cmath>
#include <numbers>

namespace vla {

std::vector<float> sinusoidal_time_embedding(std::span<const float> times, int d, double min_period,
                                             double max_period) {
  const int half = d / 2;
  std::vector<float> table;
  for (float time : times) {
    const auto angle = [&](int i) {
      const double fraction = half > 1 ? static_cast<double>(i) / (half - 1) : 0.0;
      const double period = min_period * std::pow(max_period / min_period, fraction);
      return 1.0 / period * 2 * std::numbers::pi * double{time};
    };
    for (int i = 0; i < half; ++i) table.push_back(static_cast<float>(std::sin(angle(i))));
    for (int i = 0; i < half; ++i) table.push_back(static_cast<float>(std::cos(angle(i))));
  }
  return table;
}

}  // namespace vla

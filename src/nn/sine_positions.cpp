// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "nn/sine_positions.h"

#include <fmt/format.h>

#include <cmath>
#include <numbers>

namespace vla {
namespace {

constexpr float kTemperature = 10000.0f, kEps = 1e-6f, kTwoPi = 2 * std::numbers::pi_v<float>;

/// Writes sine and cosine of position i of n, for d / 2 frequencies, starting at `to`.
void put_pairs(int i, int n, int d, float* to) {
  const float angle = static_cast<float>(i + 1) / (static_cast<float>(n) + kEps) * kTwoPi;
  for (int j = 0; j < d; j += 2) {
    const float period = std::pow(kTemperature, static_cast<float>(j) / static_cast<float>(d));
    to[j] = std::sin(angle / period), to[j + 1] = std::cos(angle / period);
  }
}

}  // namespace

Tensor sine_positions(Graph& g, int n_column, int n_row, int d_model) {
  const int half = d_model / 2;
  const auto make = [&] {
    std::vector<float> values(static_cast<std::size_t>(d_model) * static_cast<std::size_t>(n_column * n_row));
    float* to = values.data();
    for (int row = 0; row < n_row; ++row)
      for (int column = 0; column < n_column; ++column, to += d_model) {
        put_pairs(row, n_row, half, to);
        put_pairs(column, n_column, half, to + half);
      }
    return values;
  };
  return g.constant(fmt::format("sine_positions/{}/{}/{}", n_column, n_row, d_model),
                    {d_model, std::int64_t{n_column} * n_row, 1, 1}, make);
}

}  // namespace vla

// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "nn/rope.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <cmath>
#include <numeric>

#include "kernels/elementwise.h"

namespace vla {
namespace {

/// [d_head, n_token]: per token d/2 cosines, then d/2 sines, each rounded once from double.
std::vector<float> rotary_table(int d_head, float base, RotaryAngle rule, std::span<const int> positions) {
  std::vector<float> table;
  table.reserve(static_cast<std::size_t>(d_head) * positions.size());
  for (int place : positions) {
    const auto angle = [&](int i) {
      const float exponent = 2.0f / static_cast<float>(d_head) * static_cast<float>(i);
      const float position = static_cast<float>(place),
                  period = static_cast<float>(std::pow(double{base}, double{exponent}));
      return rule == RotaryAngle::quotient ? position / period : position * (1.0f / period);
    };
    for (int i = 0; i < d_head / 2; ++i) table.push_back(static_cast<float>(std::cos(double{angle(i)})));
    for (int i = 0; i < d_head / 2; ++i) table.push_back(static_cast<float>(std::sin(double{angle(i)})));
  }
  return table;
}

}  // namespace

Tensor rope(Graph& g, Tensor x, float base, RotaryAngle angle, std::span<const int> positions) {
  const int d_head = static_cast<int>(x.dim(0));
  const std::string key =
      fmt::format("rope/{}/{}/{}/{}", base, static_cast<int>(angle), d_head, fmt::join(positions, "/"));
  const Tensor table = g.constant(key, [&](Store& store) {
    return store.add_constant(rotary_table(d_head, base, angle, positions), {d_head, x.dim(2)});
  });
  return kernels::rotate_half(g, x, table);
}

Tensor rope(Graph& g, Tensor x, float base, RotaryAngle angle, int first) {
  std::vector<int> positions(static_cast<std::size_t>(x.dim(2)));
  std::iota(positions.begin(), positions.end(), first);
  return rope(g, x, base, angle, positions);
}

}  // namespace vla

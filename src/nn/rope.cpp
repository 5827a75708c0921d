// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "nn/rope.h"

#include <fmt/format.h>

#include <cmath>

#include "kernels/elementwise.h"

namespace vla {
namespace {

/// [d_head, n_token]: per token d/2 cosines, then d/2 sines, each rounded once from double.
std::vector<float> rotary_table(int d_head, float base, RotaryAngle rule, int first, int n_token) {
  std::vector<float> table;
  table.reserve(static_cast<std::size_t>(d_head) * static_cast<std::size_t>(n_token));
  for (int token = 0; token < n_token; ++token) {
    const auto angle = [&](int i) {
      const float exponent = 2.0f / static_cast<float>(d_head) * static_cast<float>(i);
      const float position = static_cast<float>(first + token),
                  period = static_cast<float>(std::pow(double{base}, double{exponent}));
      return rule == RotaryAngle::quotient ? position / period : position * (1.0f / period);
    };
    for (int i = 0; i < d_head / 2; ++i) table.push_back(static_cast<float>(std::cos(double{angle(i)})));
    for (int i = 0; i < d_head / 2; ++i) table.push_back(static_cast<float>(std::sin(double{angle(i)})));
  }
  return table;
}

}  // namespace

Tensor rope(Graph& g, Tensor x, float base, RotaryAngle angle, int first) {
  const int d_head = static_cast<int>(x.dim(0)), n_token = static_cast<int>(x.dim(2));
  const std::string key = fmt::format("rope/{}/{}/{}/{}/{}", base, static_cast<int>(angle), d_head, first, n_token);
  const Tensor table = g.constant(key, [&](Store& store) {
    return store.add_constant(rotary_table(d_head, base, angle, first, n_token), {d_head, n_token});
  });
  return kernels::rotate_half(g, x, table);
}

}  // namespace vla

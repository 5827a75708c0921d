// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "nn/rope.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <cmath>
#include <numbers>
#include <numeric>

#include "base/bf16.h"
#include "nn/tokens.h"

namespace vla {
namespace {

/// The angle of a pair: a token's coordinate on one axis, divided by base^exponent.
struct Pair {
  int axis;
  float exponent;
};

/// Cosines and sines are rounded once from double.
Tensor make_table(Graph& g, float base, RotaryAngle rule, const std::vector<Pair>& pairs,
                  const std::vector<PositionId>& positions) {
  std::string key = fmt::format("rope/{}/{}/{}", base, static_cast<int>(rule), fmt::join(positions, "/"));
  for (const Pair& pair : pairs) key += fmt::format("/{}:{}", pair.axis, pair.exponent);
  const auto rounded = [&](float x) { return rule == RotaryAngle::bfloat16 ? from_bf16(to_bf16(x)) : x; };
  const auto angle = [&](const PositionId& id, const Pair& pair) {
    const float position = static_cast<float>(id[static_cast<std::size_t>(pair.axis)]);
    const float period = static_cast<float>(std::pow(double{base}, double{pair.exponent}));
    if (rule == RotaryAngle::quotient) return double{position / period};
    return double{rounded(rounded(position) * rounded(1.0f / period))};
  };
  const auto d_head = static_cast<std::int64_t>(2 * pairs.size()), n = static_cast<std::int64_t>(positions.size());
  return g.constant(key, {d_head, n, 1, 1}, [&] {
    std::vector<float> table;
    for (const PositionId& id : positions) {
      for (const Pair& pair : pairs) table.push_back(rounded(static_cast<float>(std::cos(angle(id, pair)))));
      for (const Pair& pair : pairs) table.push_back(rounded(static_cast<float>(std::sin(angle(id, pair)))));
    }
    return table;
  });
}

}  // namespace

Tensor apply_rope(Graph& g, Tensor x, float base, RotaryAngle angle, int first) {
  std::vector<int> positions(static_cast<std::size_t>(x.dim(2)));
  std::iota(positions.begin(), positions.end(), first);
  return apply_rope(g, x, rotary_table(g, static_cast<int>(x.dim(0)), base, angle, positions));
}

Tensor apply_uneven_rope(Graph& g, Tensor x, float base) {
  const auto half = static_cast<int>(x.dim(0) / 2);
  const Tensor pairs = reshape(g, x, {2, half, x.dim(1), x.dim(2)});
  const Tensor halves = reshape(g, permute(g, pairs, {1, 0, 2, 3}), {x.dim(0), x.dim(1), x.dim(2), 1});
  std::vector<PositionId> ids;
  for (int i = 0; i < x.dim(2); ++i) ids.push_back({i, 0, 0});
  std::vector<Tensor> parts;
  for (const int which : {0, 1}) {  // the first of each pair, the second
    std::vector<Pair> angles;
    for (int i = 0; i < half; ++i)
      angles.push_back({0, static_cast<float>(2 * ((2 * i + which) % half)) / static_cast<float>(2 * half)});
    const Tensor turned = apply_rope(g, halves, make_table(g, base, RotaryAngle::bfloat16, angles, ids));
    parts.push_back(slice_features(g, turned, which * half, half));
  }
  return concat(g, parts, 0);
}

Tensor rotary_table(Graph& g, int d_head, float base, RotaryAngle angle, std::span<const int> positions) {
  std::vector<Pair> pairs;
  for (int i = 0; i < d_head / 2; ++i) pairs.push_back({0, 2.0f / static_cast<float>(d_head) * static_cast<float>(i)});
  std::vector<PositionId> ids;
  for (const int position : positions) ids.push_back({position, 0, 0});
  return make_table(g, base, angle, pairs, ids);
}

Tensor grid_rotary_table(Graph& g, int d_head, float base, const std::vector<PositionId>& positions) {
  std::vector<Pair> pairs;
  for (const int axis : {1, 2})
    for (int i = 0; i < d_head / 4; ++i)
      pairs.push_back({axis, static_cast<float>(2 * i) / static_cast<float>(d_head / 2)});
  return make_table(g, base, RotaryAngle::product, pairs, positions);
}

Tensor centre_rotary_table(Graph& g, int d_head, float base, int n_first, int n_row, int n_column) {
  const auto put_token = [&](std::vector<float>& table, float x, float y) {
    std::vector<double> angles;
    for (const float at : {y, x})
      for (int i = 0; i < d_head / 4; ++i) {
        const auto exponent = static_cast<float>(i * (4.0 / d_head));
        const float frequency = 1.0f / static_cast<float>(std::pow(double{base}, double{exponent}));
        angles.push_back(double{2 * std::numbers::pi_v<float> * at * frequency});
      }
    for (const double angle : angles) table.push_back(static_cast<float>(std::cos(angle)));
    for (const double angle : angles) table.push_back(static_cast<float>(std::sin(angle)));
  };
  const auto centre = [](int i, int n) {
    return 2.0f * ((static_cast<float>(i) + 0.5f) / static_cast<float>(n)) - 1.0f;
  };
  const auto make = [&] {
    std::vector<float> table;
    for (int i = 0; i < n_first; ++i) put_token(table, 0, 0);
    for (int row = 0; row < n_row; ++row)
      for (int column = 0; column < n_column; ++column) put_token(table, centre(column, n_column), centre(row, n_row));
    return table;
  };
  return g.constant(fmt::format("centre_rope/{}/{}/{}/{}/{}", d_head, base, n_first, n_row, n_column),
                    {d_head, n_first + std::int64_t{n_row} * n_column, 1, 1}, make);
}

Tensor mrope_table(Graph& g, int d_head, float base, const std::array<int, 3>& sections,
                   const std::vector<PositionId>& positions) {
  std::vector<Pair> pairs;
  for (int i = 0; i < d_head / 2; ++i) {
    const int axis = i / 3 < sections[static_cast<std::size_t>(i % 3)] ? i % 3 : 0;
    pairs.push_back({axis, static_cast<float>(2 * i) / static_cast<float>(d_head)});
  }
  return make_table(g, base, RotaryAngle::product, pairs, positions);
}

}  // namespace vla

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

/// What a pair turns by: the coordinate of a token on one axis, over base^exponent.
struct Pair {
  int axis;
  float exponent;
};

/// Cosines and sines are rounded once from double.
Tensor make_table(Graph& g, float base, RotaryAngle rule, const std::vector<Pair>& pairs,
                  const std::vector<Place>& places) {
  std::string key = fmt::format("rope/{}/{}/{}", base, static_cast<int>(rule), fmt::join(places, "/"));
  for (const Pair& pair : pairs) key += fmt::format("/{}:{}", pair.axis, pair.exponent);
  const auto angle = [&](const Place& place, const Pair& pair) {
    const float position = static_cast<float>(place[static_cast<std::size_t>(pair.axis)]);
    const float period = static_cast<float>(std::pow(double{base}, double{pair.exponent}));
    return double{rule == RotaryAngle::quotient ? position / period : position * (1.0f / period)};
  };
  return g.constant(key, [&](Store& store) {
    std::vector<float> table;
    for (const Place& place : places) {
      for (const Pair& pair : pairs) table.push_back(static_cast<float>(std::cos(angle(place, pair))));
      for (const Pair& pair : pairs) table.push_back(static_cast<float>(std::sin(angle(place, pair))));
    }
    return store.add_constant(std::move(table),
                              {static_cast<std::int64_t>(2 * pairs.size()), static_cast<std::int64_t>(places.size())});
  });
}

}  // namespace

Tensor rope(Graph& g, Tensor x, Tensor table) { return kernels::rotate_half(g, x, table); }

Tensor rope(Graph& g, Tensor x, float base, RotaryAngle angle, int first) {
  std::vector<int> positions(static_cast<std::size_t>(x.dim(2)));
  std::iota(positions.begin(), positions.end(), first);
  return rope(g, x, rotary_table(g, static_cast<int>(x.dim(0)), base, angle, positions));
}

Tensor rotary_table(Graph& g, int d_head, float base, RotaryAngle angle, std::span<const int> positions) {
  std::vector<Pair> pairs;
  for (int i = 0; i < d_head / 2; ++i) pairs.push_back({0, 2.0f / static_cast<float>(d_head) * static_cast<float>(i)});
  std::vector<Place> places;
  for (const int position : positions) places.push_back({position, 0, 0});
  return make_table(g, base, angle, pairs, places);
}

Tensor grid_rotary_table(Graph& g, int d_head, float base, const std::vector<Place>& places) {
  std::vector<Pair> pairs;
  for (const int axis : {1, 2})
    for (int i = 0; i < d_head / 4; ++i)
      pairs.push_back({axis, static_cast<float>(2 * i) / static_cast<float>(d_head / 2)});
  return make_table(g, base, RotaryAngle::product, pairs, places);
}

Tensor interleaved_rotary_table(Graph& g, int d_head, float base, const std::array<int, 3>& sections,
                                const std::vector<Place>& places) {
  std::vector<Pair> pairs;
  for (int i = 0; i < d_head / 2; ++i) {
    const int axis = i / 3 < sections[static_cast<std::size_t>(i % 3)] ? i % 3 : 0;
    pairs.push_back({axis, static_cast<float>(2 * i) / static_cast<float>(d_head)});
  }
  return make_table(g, base, RotaryAngle::product, pairs, places);
}

}  // namespace vla

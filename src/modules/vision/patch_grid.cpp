// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/vision/patch_grid.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>

#include "nn/tokens.h"

namespace vla {
namespace {

/// The position of patch i of n between two neighbours along one side of the table.
struct Stretch {
  int below, above;
  float fraction;
};

/// torch.linspace(0, n_side - 1, n)[i], which counts from the nearer end.
Stretch stretch(int i, int n, int n_side) {
  const float last = static_cast<float>(n_side - 1), step = n > 1 ? last / static_cast<float>(n - 1) : 0.0f;
  const float at = i < n / 2 || n == 1 ? step * static_cast<float>(i) : last - step * static_cast<float>(n - 1 - i);
  const int below = static_cast<int>(at);
  return {below, std::min(below + 1, n_side - 1), at - static_cast<float>(below)};
}

/// The neighbours along one side of the table that a patch sums, with their weights.
struct Window {
  int first;
  std::vector<float> weights;
  int at(std::size_t i) const { return first + static_cast<int>(i); }
};

/// torch's bilinear resize of `n_in` values to `n_out`, antialiased.
std::vector<Window> windows(int n_in, int n_out) {
  const double scale = static_cast<double>(n_in) / n_out, support = std::max(scale, 1.0);
  std::vector<Window> windows;
  for (int i = 0; i < n_out; ++i) {
    const double center = (i + 0.5) * scale;
    const int first = std::max(static_cast<int>(center - support + 0.5), 0);
    const int end = std::min(static_cast<int>(center + support + 0.5), n_in);
    std::vector<double> exact;
    double sum = 0.0;
    for (int x = first; x < end; ++x) {
      exact.push_back(std::max(0.0, 1.0 - std::abs((x - center + 0.5) / support)));
      sum += exact.back();
    }
    Window window{first, {}};
    for (const double weight : exact) window.weights.push_back(static_cast<float>(weight / sum));
    windows.push_back(std::move(window));
  }
  return windows;
}

std::size_t longest(const std::vector<Window>& windows) {
  std::size_t most = 0;
  for (const Window& window : windows) most = std::max(most, window.weights.size());
  return most;
}

}  // namespace

std::vector<PositionId> merge_block_places(int n_row, int n_column, int merge) {
  std::vector<PositionId> places;
  for (int row = 0; row < n_row; row += merge)
    for (int column = 0; column < n_column; column += merge)
      for (int i = 0; i < merge * merge; ++i) places.push_back({0, row + i / merge, column + i % merge});
  return places;
}

PositionBlend blend_positions(const std::vector<PositionId>& places, int n_row, int n_column, int n_side) {
  PositionBlend blend{std::vector<std::vector<std::int32_t>>(4), std::vector<std::vector<float>>(4)};
  for (const auto& [time, row, column] : places) {
    const Stretch y = stretch(row, n_row, n_side), x = stretch(column, n_column, n_side);
    for (std::size_t corner = 0; corner < 4; ++corner) {
      const bool down = corner / 2 == 1, right = corner % 2 == 1;
      blend.ids[corner].push_back((down ? y.above : y.below) * n_side + (right ? x.above : x.below));
      blend.weights[corner].push_back((down ? y.fraction : 1 - y.fraction) * (right ? x.fraction : 1 - x.fraction));
    }
  }
  return blend;
}

PositionBlend resize_positions(int n_row, int n_column, int n_side) {
  const std::vector<Window> rows = windows(n_side, n_row), columns = windows(n_side, n_column);
  const std::size_t n_down = longest(rows), n_right = longest(columns);
  PositionBlend blend{std::vector<std::vector<std::int32_t>>(n_down * n_right),
                      std::vector<std::vector<float>>(n_down * n_right)};
  for (const Window& row : rows)
    for (const Window& column : columns)
      for (std::size_t k = 0; k < blend.ids.size(); ++k) {
        const std::size_t down = k / n_right, right = k % n_right;
        const bool inside = down < row.weights.size() && right < column.weights.size();
        blend.ids[k].push_back(inside ? row.at(down) * n_side + column.at(right) : 0);
        blend.weights[k].push_back(inside ? row.weights[down] * column.weights[right] : 0.0f);
      }
  return blend;
}

Tensor blended(Graph& g, const Embedding& table, const PositionBlend& blend) {
  Tensor sum;
  for (std::size_t k = 0; k < blend.ids.size(); ++k) {
    const Tensor rows = table.forward(g, constant_ids(g, fmt::format("position/{}", k), blend.ids[k]));
    const Tensor weights = g.constant(blend.weights[k], {1, rows.dim(1), 1, 1});
    const Tensor part = multiply(g, rows, weights);
    sum = sum ? add(g, sum, part) : part;
  }
  return sum;
}

}  // namespace vla

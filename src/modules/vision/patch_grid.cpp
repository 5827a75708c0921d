// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/vision/patch_grid.h"

#include <algorithm>

namespace vla {
namespace {

/// Where patch i of n lies between two neighbours on a side of the table.
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

}  // namespace

std::vector<Place> merge_block_places(int n_row, int n_column, int merge) {
  std::vector<Place> places;
  for (int row = 0; row < n_row; row += merge)
    for (int column = 0; column < n_column; column += merge)
      for (int i = 0; i < merge * merge; ++i) places.push_back({0, row + i / merge, column + i % merge});
  return places;
}

PositionBlend blend_positions(const std::vector<Place>& places, int n_row, int n_column, int n_side) {
  PositionBlend blend;
  for (const auto& [time, row, column] : places) {
    const Stretch y = stretch(row, n_row, n_side), x = stretch(column, n_column, n_side);
    for (int corner = 0; corner < 4; ++corner) {
      const bool down = corner / 2 == 1, right = corner % 2 == 1;
      blend.ids[corner].push_back((down ? y.above : y.below) * n_side + (right ? x.above : x.below));
      blend.weights[corner].push_back((down ? y.fraction : 1 - y.fraction) * (right ? x.fraction : 1 - x.fraction));
    }
  }
  return blend;
}

}  // namespace vla

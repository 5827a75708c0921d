// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/columns.h"

#include <algorithm>
#include <cmath>

namespace vla {

void map_columns(const ColumnAffineOp& op, std::span<float> values) {
  for (const int column : op.columns) {
    float& value = values[static_cast<std::size_t>(column)];
    value = static_cast<float>(static_cast<double>(value) * op.scale + op.shift);
  }
}

void map_columns(const HornAngleOp& op, std::span<float> values) {
  for (const int column : op.columns) {
    float& value = values[static_cast<std::size_t>(column)];
    const double x = static_cast<double>(value) * op.scale + op.shift, r = op.horn_radius, a = op.arm_length;
    const double sine = (r * r + x * x - a * a) / (2.0 * r * x);
    value = static_cast<float>(std::asin(std::clamp(sine, -1.0, 1.0)));
  }
}

void map_columns(const ThresholdOp& op, std::span<float> values) {
  for (const int column : op.columns) {
    float& value = values[static_cast<std::size_t>(column)];
    if (std::isfinite(value)) value = value > op.above ? op.then : op.otherwise;
  }
}

void hold(const ClipOp& op, std::span<float> values) {
  for (float& value : values)
    if (std::isfinite(value)) value = std::clamp(value, op.low, op.high);
}

std::vector<int> bins(const BinsOp& op, std::span<const float> values) {
  std::vector<double> edges;
  const double step = (op.high - op.low) / op.count;
  for (int i = 0; i < op.count; ++i) edges.push_back(i * step + op.low);
  std::vector<int> numbers;
  for (const float value : values) {
    const auto above = std::upper_bound(edges.begin(), edges.end(), static_cast<double>(value));
    numbers.push_back(static_cast<int>(above - edges.begin()) - 1);
  }
  return numbers;
}

}  // namespace vla

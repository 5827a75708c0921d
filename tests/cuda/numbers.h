// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cmath>
#include <cstdint>
#include <random>
#include <vector>

#include "base/activation.h"
#include "base/bf16.h"

/// Operands of kernels, and how far their results are from those of doubles.
namespace vla::test::cuda {

class Numbers {
 public:
  std::vector<float> floats(std::int64_t n, float size = 1) {
    std::normal_distribution<float> normal(0, size);
    std::vector<float> values(static_cast<std::size_t>(n));
    for (float& value : values) value = normal(random_);
    return values;
  }

 private:
  std::mt19937 random_{11};
};

/// Rows of n floats as bf16 rows that are `stride` elements apart, with NaN behind them.
inline std::vector<std::uint16_t> bf16_rows(const std::vector<float>& values, std::int64_t n, std::int64_t stride) {
  std::vector<std::uint16_t> rows(values.size() / static_cast<std::size_t>(n) * static_cast<std::size_t>(stride),
                                  0xffff);
  for (std::size_t i = 0; i < values.size(); ++i)
    rows[i / static_cast<std::size_t>(n) * static_cast<std::size_t>(stride) + i % static_cast<std::size_t>(n)] =
        to_bf16(values[i]);
  return rows;
}
inline std::vector<float> widened(const std::vector<std::uint16_t>& values) {
  std::vector<float> wide;
  for (std::uint16_t value : values) wide.push_back(from_bf16(value));
  return wide;
}
inline std::vector<float> rounded_to_bf16(std::vector<float> values) {
  for (float& value : values) value = from_bf16(to_bf16(value));
  return values;
}

/// The largest error, as a share of the largest number; infinite where something is not a number.
inline double error(const std::vector<float>& found, const std::vector<double>& expected) {
  double most = 0, worst = 0;
  if (found.size() != expected.size()) return INFINITY;
  for (std::size_t i = 0; i < expected.size(); ++i) {
    const double off = std::fabs(static_cast<double>(found[i]) - expected[i]);
    if (!(off < INFINITY)) return INFINITY;
    most = std::fmax(most, std::fabs(expected[i])), worst = std::fmax(worst, off);
  }
  return worst / most;
}

inline double activated(Activation activation, double x) {
  switch (activation) {
    case Activation::none:
      return x;
    case Activation::gelu_tanh:
      return 0.5 * x * (1 + std::tanh(0.7978845608028654 * (x + 0.044715 * x * x * x)));
    case Activation::gelu_erf:
      return 0.5 * x * (1 + std::erf(x / std::sqrt(2.0)));
    case Activation::silu:
      return x / (1 + std::exp(-x));
    case Activation::relu:
      return std::fmax(x, 0);
    case Activation::relu_squared:
      return std::fmax(x, 0) * std::fmax(x, 0);
    case Activation::mish:
      return x * std::tanh(std::log1p(std::exp(x)));
  }
  return x;
}

}  // namespace vla::test::cuda

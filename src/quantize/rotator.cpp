// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "quantize/rotator.h"

#include <algorithm>
#include <cmath>
#include <numbers>
#include <random>

namespace vla {

Rotator::Rotator(std::int64_t d) : n_rest_(d) {
  while (n_rest_ % 2 == 0) n_rest_ /= 2, n_power_ *= 2;
  for (std::int64_t k = 0; k < n_rest_; ++k)
    for (std::int64_t i = 0; i < n_rest_; ++i) {
      const auto n = static_cast<double>(n_rest_);
      const double angle = std::numbers::pi * (static_cast<double>(i) + 0.5) * static_cast<double>(k) / n;
      cosines_.push_back(std::sqrt((k == 0 ? 1 : 2) / n) * std::cos(angle));
    }
  std::mt19937 random(54);
  for (std::int64_t i = 0; i < d; ++i)
    signs_.push_back((i == 0 || random() % 2 == 0 ? 1.0 : -1.0) / static_cast<double>(n_power_));
}

void Rotator::rotate(double* x, std::int64_t n) {
  cosines(x, n, false);
  hadamard(x, n);
  for (std::int64_t k = 0; k < d(); ++k)
    for (std::int64_t i = 0; i < n; ++i) x[k * n + i] *= signs_[static_cast<std::size_t>(k)];
  hadamard(x, n);
  cosines(x, n, true);
}

/// Not scaled: two of them multiply by n_power_.
void Rotator::hadamard(double* x, std::int64_t n) const {
  for (std::int64_t apart = n_rest_ * n; apart < d() * n; apart *= 2)
    for (double* pair = x; pair < x + d() * n; pair += 2 * apart)
      for (std::int64_t i = 0; i < apart; ++i) {
        const double a = pair[i], b = pair[i + apart];
        pair[i] = a + b, pair[i + apart] = a - b;
      }
}

void Rotator::cosines(double* x, std::int64_t n, bool is_inverse) {
  if (n_rest_ == 1) return;
  for (double* part = x; part < x + d() * n; part += n_rest_ * n) {
    part_.assign(static_cast<std::size_t>(n_rest_ * n), 0);
    for (std::int64_t to = 0; to < n_rest_; ++to)
      for (std::int64_t from = 0; from < n_rest_; ++from) {
        const double by = cosines_[static_cast<std::size_t>(is_inverse ? from * n_rest_ + to : to * n_rest_ + from)];
        for (std::int64_t i = 0; i < n; ++i) part_[static_cast<std::size_t>(to * n + i)] += by * part[from * n + i];
      }
    std::ranges::copy(part_, part);
  }
}

}  // namespace vla

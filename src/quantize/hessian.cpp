// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "quantize/hessian.h"

#include <algorithm>
#include <cmath>

#include "kernels/quantize_weights.h"

namespace vla {
namespace {

constexpr std::int64_t kMaxRows = 128;  // rows used of one value: tokens of an image are much alike
constexpr double kDamping = 0.01;       // fraction of H's mean diagonal, added to the diagonal: GPTQ's percdamp

/// Calls f(first column, columns, offset of the stretch's matrix) for each stretch.
template <class F>
void each_stretch(std::int64_t d, F f) {
  for (std::int64_t first = 0, offset = 0; first < d; first += kernels::kStretch) {
    const std::int64_t n = std::min(kernels::kStretch, d - first);
    f(first, n, offset);
    offset += n * n;
  }
}

double dot(const double* a, const double* b, std::int64_t n) {
  double sum = 0;
  for (std::int64_t i = 0; i < n; ++i) sum += a[i] * b[i];
  return sum;
}

/// Computes the upper triangular M with H = M Mᵀ from H's upper triangle, last column first.
std::vector<double> factor(const float* h, std::int64_t n) {
  std::vector<double> m(static_cast<std::size_t>(n * n));
  double trace = 0;
  for (std::int64_t k = 0; k < n; ++k) trace += h[k * n + k];
  const double damping = kDamping * trace / static_cast<double>(n);
  for (std::int64_t k = n - 1; k >= 0; --k) {
    const double* const right = &m[static_cast<std::size_t>(k * n + k + 1)];  // row k after the diagonal, known already
    const std::int64_t n_right = n - k - 1;
    const double square = h[k * n + k] + damping - dot(right, right, n_right);
    const double diagonal = std::sqrt(std::max(square, damping));
    if (diagonal == 0) continue;  // this column was never multiplied by anything but zeros
    for (std::int64_t j = 0; j < k; ++j)
      m[static_cast<std::size_t>(j * n + k)] =
          (h[j * n + k] - dot(&m[static_cast<std::size_t>(j * n + k + 1)], right, n_right)) / diagonal;
    m[static_cast<std::size_t>(k * n + k)] = diagonal;
  }
  return m;
}

}  // namespace

std::size_t Hessian::size(std::int64_t d) {
  std::size_t n_sum = 0;
  each_stretch(d, [&](std::int64_t, std::int64_t n, std::int64_t) { n_sum += static_cast<std::size_t>(n * n); });
  return n_sum * sizeof(float);
}

Hessian::Hessian(std::int64_t d) : d_(d), sums_(size(d) / sizeof(float)) {}

void Hessian::add(std::span<const float> rows) {
  const std::int64_t n_row = static_cast<std::int64_t>(rows.size()) / d_;
  const std::int64_t apart = (n_row + kMaxRows - 1) / kMaxRows;
  each_stretch(d_, [&](std::int64_t first, std::int64_t n, std::int64_t offset) {
    for (std::int64_t i = 0; i < n; ++i) {
      float* const sums = sums_.data() + offset + i * n;
      for (std::int64_t r = 0; r < n_row; r += apart) {
        const float* const x = rows.data() + r * d_ + first;
        for (std::int64_t j = i; j < n; ++j) sums[j] += x[i] * x[j];
      }
    }
  });
}

std::vector<float> Hessian::feedback() && {
  each_stretch(d_, [&](std::int64_t, std::int64_t n, std::int64_t offset) {
    float* const to = sums_.data() + offset;
    const std::vector<double> m = factor(to, n);
    for (std::int64_t k = 0; k < n; ++k) {
      const double diagonal = m[static_cast<std::size_t>(k * n + k)];
      for (std::int64_t j = 0; j < n; ++j)
        to[j * n + k] =
            j < k && diagonal > 0 ? static_cast<float>(m[static_cast<std::size_t>(j * n + k)] / diagonal) : 0.0f;
    }
  });
  return std::move(sums_);
}

}  // namespace vla

// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "cuda/kernels/device.h"
#include "cuda/kernels/linear_int8.h"

namespace vla::cuda {

/// float(sum) * (scale of the column / scale of the row). After a row's codes come its scale and the sum of its codes.
struct RowScale {
  float s = 1;
  int sum = 0;
  RowScale() = default;
  VLA_DEVICE RowScale(const LinearInt8Job& job, int row) {
    const std::byte* behind = job.x + row * job.x_stride + job.depth;
    s = *reinterpret_cast<const float*>(behind), sum = *reinterpret_cast<const int*>(behind + 4);
  }
  VLA_DEVICE float scaled(int product, float scale) const {
    return dev::multiply(static_cast<float>(product), dev::divide(scale, s));
  }
};

/// Whether a number's exponent is far enough from its limits for `quotient`.
VLA_DEVICE bool is_plain(float x) {
  constexpr unsigned kLeast = 127 - 40, kRange = 80;
  return (static_cast<unsigned>(dev::bits_of(x)) >> 23 & 255) - kLeast <= kRange;
}
/// Returns a / b, rounded as a division rounds it. a and b are plain, or a is 0; reciprocal is 1 / b, rounded. The
/// first correction gives one of the two floats around a / b. Its remainder is exact by FMA, so the second correction
/// rounds right (P. Markstein, IBM Journal of Research and Development 34, 1990). A division branches, and an epilogue
/// that divides for each sum spends most of its time there.
VLA_DEVICE float quotient(float a, float b, float reciprocal) {
  float q = dev::multiply(a, reciprocal);
  q = dev::multiply_add(dev::multiply_add(-b, q, a), reciprocal, q);
  return dev::multiply_add(dev::multiply_add(-b, q, a), reciprocal, q);
}

/// A row's scale, its reciprocal, the sum of the row's codes, and whether the scale is plain: four words, which the
/// compiler then reads and writes at once.
struct alignas(16) RowOfCodes {
  float s, reciprocal;
  int sum, is_plain;
  RowOfCodes() = default;
  VLA_DEVICE RowOfCodes(const LinearInt8Job& job, int row) {
    const RowScale of(job, row);
    s = of.s, reciprocal = dev::divide(1, s), sum = of.sum, is_plain = cuda::is_plain(s);
  }
};

/// The scales of four columns, each divided by a row's, and the sum of the row's codes.
struct RowRatios {
  float of[4] = {};
  int sum = 0;
  RowRatios() = default;
  /// are_plain: every scale of a column is plain or 0.
  VLA_DEVICE RowRatios(const RowOfCodes& row, const float (&scale)[4], bool are_plain) : sum(row.sum) {
#pragma unroll
    for (int c = 0; c < 4; ++c) of[c] = quotient(scale[c], row.s, row.reciprocal);
    if (are_plain && row.is_plain) return;
#pragma unroll
    for (int c = 0; c < 4; ++c) of[c] = dev::divide(scale[c], row.s);
  }
  VLA_DEVICE float scaled(int product, int c) const { return dev::multiply(static_cast<float>(product), of[c]); }
};

}  // namespace vla::cuda

// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>

namespace vla {

/// A 3 x 3 matrix, row by row.
template <class T>
using Matrix3 = std::array<T, 9>;

/// Each product and sum is rounded to T, in order.
template <class T>
Matrix3<T> product(const Matrix3<T>& a, const Matrix3<T>& b) {
  Matrix3<T> out{};
  for (std::size_t i = 0; i < 3; ++i)
    for (std::size_t j = 0; j < 3; ++j)
      for (std::size_t k = 0; k < 3; ++k) out[3 * i + j] += a[3 * i + k] * b[3 * k + j];
  return out;
}

}  // namespace vla

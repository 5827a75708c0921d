// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "kernels/vec.h"

namespace vla::kernels {

/// Computes y[n] from x[n] and parameters: vectors w and b, a scalar s. x and y may be the same.
using RowKernel = void (*)(const float* x, const float* w, const float* b, float s, float* y, std::int64_t n);

/// Preprocessing of a row of queries or keys: a norm over the head, then a rotation. Both are optional.
struct RowPrep {
  RowKernel norm = nullptr;
  const float* weight = nullptr;
  float eps = 0;
  RowKernel rotate = nullptr;
  const float* table = nullptr;  // [d_head, n_token]

  explicit operator bool() const { return norm != nullptr || rotate != nullptr; }
  /// Returns row x of token i after preprocessing. `room` has d_head elements and receives the result if there is a
  /// step.
  VLA_INLINE const float* operator()(const float* x, std::int64_t i, std::int64_t d_head, float* room) const {
    if (norm != nullptr) norm(x, weight, nullptr, eps, room, d_head), x = room;
    if (rotate != nullptr) rotate(x, table + i * d_head, nullptr, 0, room, d_head), x = room;
    return x;
  }
};

}  // namespace vla::kernels

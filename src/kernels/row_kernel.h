// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "kernels/vec.h"

namespace vla::kernels {

/// y[n] from x[n] and parameters: vectors w and b, a scalar s. x and y may be the same.
using RowKernel = void (*)(const float* x, const float* w, const float* b, float s, float* y, std::int64_t n);

/// What happens to a row of queries or keys before products: a norm over the head, then a rotation. Both are optional.
struct RowPrep {
  RowKernel norm = nullptr;
  const float* weight = nullptr;
  float eps = 0;
  RowKernel rotate = nullptr;
  const float* table = nullptr;  // [d_head, n_token]

  explicit operator bool() const { return norm != nullptr || rotate != nullptr; }
  /// Row x of token i; `room` for d_head elements receives the result if there is any step.
  VLA_INLINE const float* operator()(const float* x, std::int64_t i, std::int64_t d_head, float* room) const {
    if (norm != nullptr) norm(x, weight, nullptr, eps, room, d_head), x = room;
    if (rotate != nullptr) rotate(x, table + i * d_head, nullptr, 0, room, d_head), x = room;
    return x;
  }
};

}  // namespace vla::kernels

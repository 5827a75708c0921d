// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "kernels/vec.h"

namespace vla::kernels {

/// y[n] of x[n], and its parameters: vectors w and b, a scalar s. x and y may be the same.
using RowKernel = void (*)(const float* x, const float* w, const float* b, float s, float* y, std::int64_t n);

/// The steps that prepare a row of queries or keys for products: a norm over the head, then a rotation. Each may be
/// missing.
struct RowPrep {
  RowKernel norm = nullptr;
  const float* weight = nullptr;
  float eps = 0;
  RowKernel rotate = nullptr;
  const float* table = nullptr;  // [d_head, n_token]

  explicit operator bool() const { return norm != nullptr || rotate != nullptr; }
  /// The row x of token i, in `room` for d_head elements where anything is done to it.
  VLA_INLINE const float* operator()(const float* x, std::int64_t i, std::int64_t d_head, float* room) const {
    if (norm != nullptr) norm(x, weight, nullptr, eps, room, d_head), x = room;
    if (rotate != nullptr) rotate(x, table + i * d_head, nullptr, 0, room, d_head), x = room;
    return x;
  }
};

}  // namespace vla::kernels

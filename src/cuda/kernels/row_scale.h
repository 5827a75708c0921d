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

}  // namespace vla::cuda

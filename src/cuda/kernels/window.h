// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "cuda/kernels/launch.h"

/// A window that moves over images (op::Window). It writes unfolded rows for a convolution's product, or for each
/// feature the maximum or a weighted sum.
namespace vla::cuda {

struct WindowJob {
  const float* x;              // [d, width, height, n_view]
  const float *weight, *bias;  // [d, size * size], [d], or null
  void* y;                     // one row per place: d * size * size elements, or d for maxima and sums; float32 or bf16
  std::int64_t y_stride;       // stride of rows in elements
  int d, width, height, n_view;
  int size, stride, padding;
  int n_column, n_row;  // places per image
  bool takes_largest, is_bf16;

  VLA_HOST_DEVICE std::int64_t n_of_row() const {
    return static_cast<std::int64_t>(takes_largest || weight != nullptr ? 1 : size * size) * d;
  }
  VLA_HOST_DEVICE std::int64_t count() const { return n_of_row() * n_column * n_row * n_view; }
};

inline Launch window_elements(const WindowJob& job) { return {"window_elements", {blocks(job.count(), 1024)}, 256}; }

}  // namespace vla::cuda

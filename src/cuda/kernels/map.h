// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "base/activation.h"
#include "cuda/kernels/launch.h"

/// Element by element over six dimensions, each operand with steps of its own: additions and products with repeated
/// dimensions, activations, copies into parts of others, patches of images and the shuffle of pixels.
namespace vla::cuda {

enum class MapOperation { copy, add, multiply };

/// y = activation(a) * factor, or activation(a + b) * factor, or activation(a * b) * factor.
struct MapJob {
  static constexpr int kDims = 6;
  const float *a, *b;                                        // b is null for a copy
  void* y;                                                   // float32 or bf16
  int size[kDims];                                           // the fastest first; 1 where there are fewer
  std::int64_t a_step[kDims], b_step[kDims], y_step[kDims];  // elements; 0 repeats
  float factor;
  MapOperation operation;
  Activation activation;
  bool is_bf16;

  VLA_HOST_DEVICE std::int64_t count() const {
    std::int64_t n = 1;
    for (int n_of : size) n *= n_of;
    return n;
  }
};

inline Launch map_elements(const MapJob& job) { return {"map_elements", {blocks(job.count(), 1024)}, 256}; }

}  // namespace vla::cuda

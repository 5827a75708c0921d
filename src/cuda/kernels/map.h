// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "base/activation.h"
#include "cuda/kernels/launch.h"

/// Elementwise operations over six dimensions, with strides for each operand: broadcast additions and products,
/// activations, copies into parts of other values, patches of images and pixel shuffle.
namespace vla::cuda {

enum class MapOperation { copy, add, multiply };

/// y = activation(a) * factor, or activation(a + b) * factor, or activation(a * b) * factor.
struct MapJob {
  static constexpr int kDims = 6;
  const float *a, *b;                                        // b is null for a copy
  void* y;                                                   // float32 or bf16
  int size[kDims];                                           // fastest first; missing dimensions are 1
  std::int64_t a_step[kDims], b_step[kDims], y_step[kDims];  // strides in elements; 0 repeats
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

/// Parts of one result, in one launch.
using MapJobs = Several<MapJob, 16>;
inline Launch map_parts(MapJobs& jobs) {
  return {"map_parts", {fill_ends(jobs, [](const MapJob& one) { return map_elements(one).grid.x; })}, 256};
}

}  // namespace vla::cuda

// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "cuda/kernels/finish.h"
#include "cuda/kernels/linear_bf16.h"

namespace vla::cuda {

/// Stores two adjacent sums over a share of the depth to columns `at` and at + 1 of a row of `partial`.
VLA_DEVICE void store_partial(const LinearBf16Job& job, float first, float second, int row, int at, bool has_second) {
  float* to = job.partial + (static_cast<std::int64_t>(blockIdx.z) * job.n_row_x() + row) * job.n_sum() + at;
  if (has_second && job.n_sum() % 2 == 0 && at % 2 == 0) {
    *reinterpret_cast<float2*>(to) = float2{first, second};
  } else {
    to[0] = first;
    if (has_second) to[1] = second;
  }
}

/// Stores two adjacent sums: the sums themselves if the depth is split, else y.
VLA_DEVICE void store_pair(const LinearBf16Job& job, float first, float second, int row, int column) {
  if (job.n_split == 1) return finish_pair(job.end, first, second, row, column, job.n_column);
  store_partial(job, first, second, row, column, column + 1 < job.n_column);
}

/// Adds the gate's bias to two sums of the gate.
VLA_DEVICE void add_gate_bias(const LinearBf16Job& job, PairEnds& ends, int column) {
  if (job.gate_bias == nullptr) return;
  ends.gate.x = dev::add(ends.gate.x, job.gate_bias[column]);
  if (ends.has_second) ends.gate.y = dev::add(ends.gate.y, job.gate_bias[column + 1]);
}

/// The cosines of a row's token from the pair at `column` on; the sines follow after d_head / 2 values.
VLA_DEVICE const float* cosines_of(const Rotation& rotation, int row, int column) {
  return rotation.table + row % rotation.n_token * rotation.d_head + column % rotation.d_head;
}

/// The steps of the depth that block z of a split computes.
struct Share {
  int first, end;
  VLA_DEVICE explicit Share(const LinearBf16Job& job) {
    const int n_step = (job.depth + kBf16Depth - 1) / kBf16Depth, z = static_cast<int>(blockIdx.z);
    first = n_step * z / job.n_split, end = n_step * (z + 1) / job.n_split;
  }
};

}  // namespace vla::cuda

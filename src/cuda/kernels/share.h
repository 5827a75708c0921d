// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "cuda/kernels/finish.h"
#include "cuda/kernels/linear_bf16.h"

namespace vla::cuda {

/// Stores two adjacent sums: the sums themselves if the depth is split, else y.
VLA_DEVICE void store_pair(const LinearBf16Job& job, float first, float second, int row, int column) {
  if (job.n_split == 1) return finish_pair(job.end, first, second, row, column, job.n_column);
  float* to = job.partial + (static_cast<std::int64_t>(blockIdx.z) * job.n_row + row) * job.n_column + column;
  to[0] = first;
  if (column + 1 < job.n_column) to[1] = second;
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

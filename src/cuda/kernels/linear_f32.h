// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "cuda/kernels/epilogue.h"
#include "cuda/kernels/launch.h"

/// Products in float32, for operands that must not be rounded, and the epilogue.
namespace vla::cuda {

struct LinearF32Job {
  const float* x;       // n_row rows with stride x_stride
  const float* weight;  // n_column rows of `depth`
  std::int64_t x_stride;
  int n_row, n_column, depth;
  Epilogue end;
};

inline Launch linear_f32(const LinearF32Job& job) {
  return {"linear_f32", {blocks(job.n_column, 64), blocks(job.n_row, 64)}, 256, 2 * 16 * (64 + 4) * 4};
}

}  // namespace vla::cuda

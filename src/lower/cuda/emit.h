// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>

#include "cuda/kernels/map.h"
#include "cuda/kernels/rows.h"
#include "lower/cuda/cuda_lowering.h"

namespace vla::lower {

/// Returns the launches of an operation; each file of lower/cuda/ops defines one. Errors: unsupported for sizes that no
/// kernel has.
#define VLA_CALLS_OF_OP(Op) Result<Calls> calls_of(const CudaLowering& l, const CudaOp& op, const Op& what);
VLA_LOWERED_OPS(VLA_CALLS_OF_OP)
VLA_CALLS_OF_OP(HeadOp)
#undef VLA_CALLS_OF_OP

/// Merges independent operations of a phase, such as those of q, k and v, into one kernel: products in strips or Hopper
/// tiles with equal rows, depth and shares, and operations on rows of heads. n_sm: SMs of the device.
void merge_calls(std::vector<Calls>& phase, int n_sm);

// Shared by the files of lower/cuda/ops.

template <class Job>
Call call(const cuda::Launch& how, const Job& job) {
  const auto* bytes = reinterpret_cast<const std::byte*>(&job);
  return {how, {bytes, bytes + sizeof(job)}};
}
inline int narrow(std::int64_t n) { return static_cast<int>(n); }
/// `more` precedes the limit `most` in the message, such as "heads of at most".
Error unsupported(const char* what, const char* more, std::int64_t most, std::int64_t found);

/// The job of an element-wise kernel over a shape of up to six dimensions, fastest first. The caller sets the operation
/// and its second operand, if any.
template <class Extents>
cuda::MapJob map_job(const Extents& shape, const float* a, const Extents& a_stride, float* y, const Extents& y_stride) {
  cuda::MapJob job = {};
  job.a = a, job.y = y, job.factor = 1;
  std::fill(std::begin(job.size), std::end(job.size), 1);
  std::transform(shape.begin(), shape.end(), job.size, narrow);
  std::copy(a_stride.begin(), a_stride.end(), job.a_step);
  std::copy(y_stride.begin(), y_stride.end(), job.y_step);
  return job;
}
/// Norms rows of x (unless norm is null) into the operation's result.
cuda::NormJob norm_job(const CudaLowering& l, const CudaOp& op, ValueId x, const Node* norm, ValueId weight,
                       ValueId bias);
/// Norms or rotates heads into the operation's result.
Result<Calls> head_calls(const CudaLowering& l, const CudaOp& op, const HeadRows& rows);

}  // namespace vla::lower

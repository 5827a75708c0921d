// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/kernels/linear_f32.h"

#include "cuda/kernels/finish.h"

namespace vla::cuda {
namespace {

constexpr int kSize = 64, kDepth = 16, kStride = kSize + 4, kThreads = 256;

/// Copies a step of the depth of 64 rows to shared memory, transposed, padded with zeros after the last row and the
/// depth.
VLA_DEVICE void fetch(std::byte* to, const float* from, std::int64_t stride, int row0, int n_row, int k0, int depth) {
#pragma unroll
  for (int i = thread_index(); i < kSize * kDepth; i += kThreads) {
    const int row = i / kDepth, k = i % kDepth;
    const bool valid = row0 + row < n_row && k0 + k < depth;
    dev::write(to + (k * kStride + row) * 4, valid ? from[(row0 + row) * stride + k0 + k] : 0.0f);
  }
}

}  // namespace

/// A thread computes 4 x 4 sums, starting at row 4 (thread / 16) and column 4 (thread % 16).
VLA_KERNEL(linear_f32, 256, 2, LinearF32Job) {
  std::byte *x = dev::shared_memory(), *w = x + kDepth * kStride * 4;
  const int row0 = static_cast<int>(blockIdx.y) * kSize, column0 = static_cast<int>(blockIdx.x) * kSize;
  const int row = thread_index() / 16 * 4, column = thread_index() % 16 * 4;
  float sum[4][4] = {};
  for (int k0 = 0; k0 < job.depth; k0 += kDepth) {
    fetch(x, job.x, job.x_stride, row0, job.n_row, k0, job.depth);
    fetch(w, job.weight, job.depth, column0, job.n_column, k0, job.depth);
    __syncthreads();
#pragma unroll
    for (int k = 0; k < kDepth; ++k) {
      const auto a = dev::read<float4>(x + (k * kStride + row) * 4),
                 b = dev::read<float4>(w + (k * kStride + column) * 4);
      const float rows[4] = {a.x, a.y, a.z, a.w}, columns[4] = {b.x, b.y, b.z, b.w};
#pragma unroll
      for (int i = 0; i < 4; ++i)
#pragma unroll
        for (int j = 0; j < 4; ++j) sum[i][j] += rows[i] * columns[j];
    }
    __syncthreads();  // all threads have read what the next step overwrites
  }
#pragma unroll
  for (int i = 0; i < 4; ++i)
#pragma unroll
    for (int j = 0; j < 4; j += 2)
      if (row0 + row + i < job.n_row && column0 + column + j < job.n_column)
        finish_pair(job.end, sum[i][j], sum[i][j + 1], row0 + row + i, column0 + column + j, job.n_column);
}

}  // namespace vla::cuda

// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/kernels/map.h"

#include "cuda/kernels/finish.h"

namespace vla::cuda {

namespace {

/// Computes kAtOnce of a thread's elements, 256 apart, so that accesses of a warp are coalesced. Loads all of them
/// before it uses any. Index: a 32-bit type, whose divisions are faster, if it can hold the index of every element.
template <int kAtOnce, class Index>
VLA_DEVICE void map(const MapJob& job, Index first, Index n) {
  float a[kAtOnce], b[kAtOnce];
  std::int64_t to[kAtOnce];
#pragma unroll
  for (int k = 0; k < kAtOnce; ++k) {
    Index rest = first + static_cast<Index>(k * 256);
    if (rest >= n) break;
    std::int64_t of_a = 0, of_b = 0;
    to[k] = 0;
#pragma unroll
    for (int d = 0; d < MapJob::kDims; ++d) {
      const auto size = static_cast<Index>(job.size[d]);
      const auto i = static_cast<std::int64_t>(rest % size);
      rest /= size;
      of_a += i * job.a_step[d], of_b += i * job.b_step[d], to[k] += i * job.y_step[d];
    }
    a[k] = job.a[of_a], b[k] = job.b ? job.b[of_b] : 0;
  }
#pragma unroll
  for (int k = 0; k < kAtOnce; ++k) {
    if (first + static_cast<Index>(k * 256) >= n) break;
    float value = a[k];
    if (job.operation == MapOperation::add) value = dev::add(value, b[k]);
    if (job.operation == MapOperation::multiply) value = dev::multiply(value, b[k]);
    value = activate(job.activation, value);
    if (job.factor != 1) value = dev::multiply(value, job.factor);  // a copy keeps all bits
    store(job.y, job.is_bf16, to[k], value);
  }
}

/// A thread computes four elements.
VLA_DEVICE void map(const MapJob& job, int block) {
  const std::int64_t n = job.count(), first = static_cast<std::int64_t>(block) * 1024 + thread_index();
  if (n < 1U << 31) return map<4>(job, static_cast<unsigned>(first), static_cast<unsigned>(n));
#pragma unroll 1
  for (int k = 0; k < 4; ++k) map<1>(job, first + k * 256, n);
}

}  // namespace

VLA_KERNEL(map_elements, 256, 4, MapJob) { map(job, static_cast<int>(blockIdx.x)); }
VLA_KERNEL(map_parts, 256, 4, MapJobs) {
  run_one(job, blockIdx.x, [](const MapJob& one, int block) { map(one, block); });
}

}  // namespace vla::cuda

// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/kernels/map.h"

#include "cuda/kernels/finish.h"

namespace vla::cuda {

/// A thread computes four elements, 256 apart, so that accesses of a warp are coalesced.
VLA_KERNEL(map_elements, 256, 4, MapJob) {
  const std::int64_t n = job.count();
  for (int k = 0; k < 4; ++k) {
    std::int64_t rest = static_cast<std::int64_t>(blockIdx.x) * 1024 + k * 256 + thread_index();
    if (rest >= n) return;
    std::int64_t a = 0, b = 0, y = 0;
#pragma unroll
    for (int d = 0; d < MapJob::kDims; ++d) {
      const std::int64_t i = rest % job.size[d];
      rest /= job.size[d];
      a += i * job.a_step[d], b += i * job.b_step[d], y += i * job.y_step[d];
    }
    float value = job.a[a];
    if (job.operation == MapOperation::add) value = dev::add(value, job.b[b]);
    if (job.operation == MapOperation::multiply) value = dev::multiply(value, job.b[b]);
    value = activate(job.activation, value);
    if (job.factor != 1) value = dev::multiply(value, job.factor);  // a copy keeps all bits
    store(job.y, job.is_bf16, y, value);
  }
}

}  // namespace vla::cuda

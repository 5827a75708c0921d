// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/kernels/channel_attention.h"

#include <cmath>

#include "cuda/kernels/device.h"

namespace vla::cuda {
namespace {

constexpr float kLogOfE = 1.44269504f;  // log2(e)

/// The score of query feature i and key feature j over all tokens. Products are summed over 64 tokens before they are
/// added to the total; thousands of single additions would cost a digit.
VLA_DEVICE float score(const ChannelAttentionJob& job, const float* q, const float* k) {
  float total = 0;
  for (int first = 0; first < job.n; first += 64) {
    float sum = 0;
    const int end = first + 64 < job.n ? first + 64 : job.n;
    for (int t = first; t < end; ++t) sum += q[t * job.q_stride] * k[t * job.k_stride];
    total += sum;
  }
  return total;
}

}  // namespace

/// Computes scores in shared memory, [key, query], their softmax, and the weighted sums of values.
VLA_KERNEL(channel_attention, 256, 4, ChannelAttentionJob) {
  std::byte* const room = dev::shared_memory();
  const int d = job.d_group(), n_pair = d * d;
  const std::int64_t first = static_cast<std::int64_t>(blockIdx.x) * d,
                     token = static_cast<std::int64_t>(blockIdx.y) * job.n;
  const float *q = job.q + token * job.q_stride + first, *k = job.k + token * job.k_stride + first,
              *v = job.v + token * job.v_stride + first;
  float* y = job.y + token * job.d + first;
  for (int pair = thread_index(); pair < n_pair; pair += 256)
    dev::write(room + pair * 4, score(job, q + pair % d, k + pair / d));
  __syncthreads();
  if (thread_index() < d) {
    std::byte* const column = room + thread_index() * 4;
    float most = dev::read<float>(column), sum = 0;
    for (int j = 1; j < d; ++j) most = fmaxf(most, dev::read<float>(column + j * d * 4));
    const float scale = kLogOfE / sqrtf(static_cast<float>(job.n));
    for (int j = 0; j < d; ++j) {
      const float weight = dev::power_of_two((dev::read<float>(column + j * d * 4) - most) * scale);
      dev::write(column + j * d * 4, weight);
      sum += weight;
    }
    for (int j = 0; j < d; ++j) dev::write(column + j * d * 4, dev::divide(dev::read<float>(column + j * d * 4), sum));
  }
  __syncthreads();
  for (int at = thread_index(); at < job.n * d; at += 256) {
    const int t = at / d, i = at % d;
    float sum = 0;
    for (int j = 0; j < d; ++j) sum += dev::read<float>(room + (j * d + i) * 4) * v[t * job.v_stride + j];
    y[static_cast<std::int64_t>(t) * job.d + i] = sum;
  }
}

}  // namespace vla::cuda

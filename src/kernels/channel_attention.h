// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "kernels/math.h"
#include "kernels/sizes.h"

/// Attention between features (op::ChannelAttention). A group is small and its scores fit into the L1 cache, so it
/// takes one pass over the tokens for the scores and one for the output.
namespace vla::kernels {

/// The most features in a group.
constexpr std::int64_t kMaxChannels = 64;

/// q, k, v, y [d, n, n_view]; `q_stride` and so on are strides of tokens, and views are `n` tokens apart.
struct ChannelAttentionJob {
  const float *q, *k, *v;
  float* y;
  std::int64_t q_stride, k_stride, v_stride;
  std::int64_t d, n, n_view, n_group;

  std::int64_t n_unit() const { return n_group * n_view; }
};

/// Computes one group of one view.
using ChannelAttentionKernel = void (*)(const ChannelAttentionJob& job, std::int64_t unit);

template <class V>
VLA_INLINE void attend_channels(const ChannelAttentionJob& job, std::int64_t unit) {
  using Float = typename V::Float;
  constexpr std::int64_t kBlock = 64;  // tokens whose products are summed before they are added to the total
  const std::int64_t d = job.d / job.n_group, first = unit % job.n_group * d, token = unit / job.n_group * job.n;
  alignas(64) float score[kMaxChannels * kMaxChannels] = {};  // [key, query]: vectors of queries
  alignas(64) float block[kMaxChannels * kMaxChannels];

  for (std::int64_t t = 0; t < job.n; t += kBlock) {
    for (std::int64_t i = 0; i < d * kMaxChannels; i += V::width) V::store(block + i, Float{});
    for (std::int64_t s = t; s < min(job.n, t + kBlock); ++s) {
      const float* q = job.q + (token + s) * job.q_stride + first;
      const float* k = job.k + (token + s) * job.k_stride + first;
      for (std::int64_t j = 0; j < d; ++j)
        for (std::int64_t i = 0; i < d; i += V::width) {
          float* sum = block + j * kMaxChannels + i;
          V::store(sum, V::fma(load<V>(q + i, d - i), V::set(k[j]), V::load(sum)));
        }
    }
    for (std::int64_t i = 0; i < d * kMaxChannels; i += V::width)
      V::store(score + i, V::load(score + i) + V::load(block + i));
  }

  const float scale = 1.0f / __builtin_sqrtf(static_cast<float>(job.n));
  for (std::int64_t i = 0; i < d; i += V::width) {  // softmax over the keys for one vector of queries
    Float most = V::load(score + i), sum = {};
    for (std::int64_t j = 1; j < d; ++j) most = V::max(most, V::load(score + j * kMaxChannels + i));
    for (std::int64_t j = 0; j < d; ++j) {
      float* at = score + j * kMaxChannels + i;
      const Float weight = exp_of_negative<V>((V::load(at) - most) * scale);
      V::store(at, weight);
      sum += weight;
    }
    for (std::int64_t j = 0; j < d; ++j) {
      float* at = score + j * kMaxChannels + i;
      V::store(at, V::divide(V::load(at), sum));
    }
  }

  for (std::int64_t s = 0; s < job.n; ++s) {
    const float* v = job.v + (token + s) * job.v_stride + first;
    float* y = job.y + (token + s) * job.d + first;
    for (std::int64_t i = 0; i < d; i += V::width) {
      Float sum = {};
      for (std::int64_t j = 0; j < d; ++j) sum = V::fma(V::load(score + j * kMaxChannels + i), V::set(v[j]), sum);
      store<V>(y + i, sum, d - i);
    }
  }
}

}  // namespace vla::kernels

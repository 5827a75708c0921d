// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "cuda/kernels/launch.h"

/// Attention between features (op::ChannelAttention). A block computes one group of one view.
namespace vla::cuda {

/// The most features in a group.
constexpr int kMaxChannels = 64;

/// q, k, v, y [d, n, n_view]; `q_stride` and so on are strides of tokens, and views are `n` tokens apart.
struct ChannelAttentionJob {
  const float *q, *k, *v;
  float* y;
  std::int64_t q_stride, k_stride, v_stride;
  int d, n, n_view, n_group;

  VLA_HOST_DEVICE int d_group() const { return d / n_group; }
};

/// The block's threads divide the group's scores among them, then the elements of y.
inline Launch channel_attention(const ChannelAttentionJob& job) {
  const unsigned d = static_cast<unsigned>(job.d_group());
  return {"channel_attention", {static_cast<unsigned>(job.n_group), static_cast<unsigned>(job.n_view)}, 256, d * d * 4};
}

}  // namespace vla::cuda

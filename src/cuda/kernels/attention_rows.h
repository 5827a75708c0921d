// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "cuda/kernels/attention.h"
#include "cuda/kernels/device.h"

/// Shared by the attention kernels: the rows of a block and their addresses.
namespace vla::cuda {

constexpr float kLog2 = 1.4426950408889634f;
constexpr float kMinusInfinity = -__builtin_huge_valf();

/// The work of block y: one head of keys and values in one batch.
struct Unit {
  int head_kv, batch;
  VLA_DEVICE explicit Unit(const AttentionJob& job)
      : head_kv(static_cast<int>(blockIdx.y) % job.n_head_kv), batch(static_cast<int>(blockIdx.y) / job.n_head_kv) {}
};
template <class T>
VLA_DEVICE const T* row_of(const HeadRows& rows, int head, int token, int batch) {
  return static_cast<const T*>(rows.data) + head * rows.head + token * rows.token + batch * rows.batch;
}
/// Row r of a unit's queries: the unit's heads for one query, then for the next.
VLA_DEVICE int query_of(const AttentionJob& job, int row) { return row / job.group(); }
VLA_DEVICE int head_of(const AttentionJob& job, const Unit& unit, int row) {
  return unit.head_kv * job.group() + row % job.group();
}

VLA_DEVICE int count_keys(const AttentionJob& job) {
  int n = 0;
  for (int i = 0; i < job.n_segment; ++i) n += job.segment[i].n_key;
  return n;
}

/// The base that is subtracted from scores: the largest score, or any finite value for a row without keys, so that its
/// weights are zero.
VLA_DEVICE float finite(float most) { return most == kMinusInfinity ? 0 : most; }

/// A score's weight where the largest score is `most`.
VLA_DEVICE float weight_of(float score, float most) { return dev::power_of_two(score - finite(most)); }

/// How a warp combines shares of a row's keys. Lane z has the largest score of share z and its sum of weights; a lane
/// without a share has minus infinity and zero.
struct RowShares {
  float most, total;

  /// To be called once. Replaces `most` by the share's weight, and `total` by the sum of weights of all shares.
  VLA_DEVICE void weigh() {
    float all = most;
    for (int mask = 16; mask > 0; mask /= 2) all = fmaxf(all, dev::shuffle_xor(all, mask));
    most = weight_of(most, all), total = sum_of_warp(total * most);
  }
  /// Adds the weighted values of shares `first` to first + kCount - 1.
  template <int kCount, int kEach>
  VLA_DEVICE void add(int first, const float (&values)[kCount][kEach], float (&sums)[kEach]) const {
#pragma unroll
    for (int z = 0; z < kCount; ++z) {
      const float weight = dev::shuffle(most, first + z);
#pragma unroll
      for (int j = 0; j < kEach; ++j) sums[j] += values[z][j] * weight;
    }
  }
};

VLA_DEVICE float* partial_row(const AttentionJob& job, int row, int split) {
  const std::int64_t unit = static_cast<std::int64_t>(split) * job.n_head_kv * job.n_batch + blockIdx.y;
  return job.partial + (unit * job.n_row() + row) * (job.d_head + 2);
}
/// The index in y of a row's first element.
VLA_DEVICE std::int64_t y_row(const AttentionJob& job, const Unit& unit, int row) {
  const std::int64_t token = static_cast<std::int64_t>(unit.batch) * job.n_query + query_of(job, row);
  return (token * job.n_head + head_of(job, unit, row)) * job.d_head;
}

}  // namespace vla::cuda

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

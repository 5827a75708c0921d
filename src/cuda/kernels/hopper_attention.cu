// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/kernels/attention_tile.h"
#include "cuda/kernels/hopper.h"

/// Attention whose shares of the keys are combined by a cluster: the blocks of the same rows, one per share.
namespace vla::cuda {
namespace {

constexpr int kOfWarp = 4 * kLanes;  // columns that a warp combines at a time, each lane four

VLA_DEVICE float number(unsigned bits) { return dev::float_of(static_cast<int>(bits)); }

/// Computes four columns of a row of y, whose sums all blocks of the cluster have at `sums`, as attention_finish does,
/// to the bit. All lanes of a warp must call it for one row.
template <class S>
VLA_DEVICE void combine_four(const AttentionJob& job, const Unit& unit, const std::byte* sums, int row, int column) {
  const int lane = thread_index() % kLanes;
  RowShares shares = {kMinusInfinity, 0};
  if (lane < job.n_split) {
    const uint4 found = dev::read_of_block(sums + S::kDepth * 4, lane);
    shares = {number(found.x), number(found.y)};
  }
  float values[kMaxCluster][4], y[4] = {};
#pragma unroll
  for (int z = 0; z < static_cast<int>(kMaxCluster); ++z) {
    const bool is_there = z < job.n_split && column < job.d_head;
    const uint4 four = is_there ? dev::read_of_block(sums + column * 4, z) : uint4{0, 0, 0, 0};
    values[z][0] = number(four.x), values[z][1] = number(four.y);
    values[z][2] = number(four.z), values[z][3] = number(four.w);
  }
  shares.weigh();
  shares.add(0, values, y);
  if (column >= job.d_head) return;
  const std::int64_t at = y_row(job, unit, row) + column;
  store_pair(job.y, job.is_bf16, at, y[0] / shares.total, y[1] / shares.total);
  store_pair(job.y, job.is_bf16, at + 2, y[2] / shares.total, y[3] / shares.total);
}

/// Computes y from the rows of sums that all blocks of the cluster have at `sums`. Blocks take parts of rows in turn.
template <class S>
VLA_DEVICE void combine(const AttentionJob& job, const Unit& unit, const std::byte* sums) {
  constexpr int kParts = (S::kDepth + kOfWarp - 1) / kOfWarp;
  const int row0 = static_cast<int>(blockIdx.x) * S::kRows;
  const int n_part = (job.n_row() - row0 < S::kRows ? job.n_row() - row0 : S::kRows) * kParts;
#pragma unroll 1
  for (int part = static_cast<int>(blockIdx.z) + job.n_split * (thread_index() / kLanes); part < n_part;
       part += job.n_split * (S::kThreads / kLanes)) {
    const int row = part / kParts, column = part % kParts * kOfWarp + thread_index() % kLanes * 4;
    combine_four<S>(job, unit, sums + row * S::kSumsRow, row0 + row, column);
  }
}

template <int kIndex>
VLA_DEVICE void attend_in_cluster(const AttentionJob& job) {
  using S = AttentionBlock<kIndex>;
  static_assert(S::kShares && S::kRows * S::kSumsRow <= S::kRows * S::kRow + 2 * S::kTile);
  std::byte* sums = dev::shared_memory();
  const Unit unit(job);
  attend_shared<S>(job, unit, [&](const AttentionWarp<S>& warp) { warp.template store_rows<true>(sums); });
  dev::meet_cluster();  // sums of all blocks are there
  combine<S>(job, unit, sums);
  dev::leave_cluster();  // no block reads them any more
}

}  // namespace

// By their index in kAttentionShapes.
VLA_EARLY_KERNEL(hopper_attention_bf16_64_32, 256, 2, AttentionJob) { attend_in_cluster<1>(job); }
VLA_EARLY_KERNEL(hopper_attention_bf16_64_16, 256, 2, AttentionJob) { attend_in_cluster<2>(job); }
VLA_EARLY_KERNEL(hopper_attention_bf16_128_32, 256, 2, AttentionJob) { attend_in_cluster<5>(job); }
VLA_EARLY_KERNEL(hopper_attention_bf16_128_16, 256, 2, AttentionJob) { attend_in_cluster<6>(job); }
VLA_EARLY_KERNEL(hopper_attention_bf16_256_32, 256, 2, AttentionJob) { attend_in_cluster<8>(job); }

}  // namespace vla::cuda

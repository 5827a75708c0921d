// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/kernels/halved_norm.h"
#include "cuda/kernels/hopper_tile.h"
#include "cuda/kernels/hopper_tma.h"

namespace vla::cuda {
namespace {

template <int kColumns_, int kRows_, bool kGated_>
struct Tile {
  static constexpr bool kGated = kGated_;
  static constexpr int kColumns = kColumns_, kRows = kRows_;
  static constexpr int kColumnsY = kGated ? kColumns / 2 : kColumns;
  static constexpr int kMultipliers = kColumns * 2;  // threads; those of the last warp fetch
  static constexpr int kStages = hopper_tma_stages(kColumns, kRows), kStage = hopper_stage_bytes(kColumns, kRows);
  static constexpr int kBytesW = kColumns * kSwizzledRow;
  static constexpr int kRowsOfBlock = kRows / kTmaCluster;  // that a block fetches
  static_assert(kRowsOfBlock % kSwizzledRows == 0 && kColumnsY % kSwizzledRows == 0 && kRows <= kMultipliers);
};

/// Stages take turns. A stage's `full` ends a phase when its operands are there, its `empty` when the warps that
/// multiply have read it, in all blocks of the cluster: what a block fetches of x goes to all of them.
template <class T>
struct Stages {
  std::byte* shared;
  int stage = 0;
  unsigned parity = 0;  // of the phases of this turn

  VLA_DEVICE void go_on() {
    if (++stage != T::kStages) return;
    stage = 0, parity ^= 1;
  }
  VLA_DEVICE std::byte* operands() const { return shared + stage * T::kStage; }
  VLA_DEVICE std::byte* full() const { return full_of(stage); }
  VLA_DEVICE std::byte* empty() const { return full_of(stage) + 8; }
  VLA_DEVICE std::byte* full_of(int i) const { return shared + T::kStages * T::kStage + i * kTmaBarriers; }
  /// For one thread of a block.
  VLA_DEVICE void begin() const {
    for (int i = 0; i < T::kStages; ++i) {
      dev::begin_mbarrier(full_of(i), 1);
      dev::begin_mbarrier(full_of(i) + 8, T::kMultipliers / kLanes * kTmaCluster);
    }
    dev::fence_mbarriers();
  }
};

/// Where a block's tile begins. The cluster's blocks are numbered in z.
template <class T>
struct Place {
  int row0 = static_cast<int>(blockIdx.x) * T::kRows;
  int rank = static_cast<int>(blockIdx.z);
  int column0 = (static_cast<int>(blockIdx.y) * kTmaCluster + rank) * T::kColumnsY;
};

/// Fetches steps of the depth.
template <class T>
struct Fetch {
  const HopperTmaJob& job;
  Place<T> place;

  /// Lets the stage expect its operands, and fetches the weights among them. Rows of the gate's matrix come first.
  VLA_DEVICE void weights(const Stages<T>& to, int step) const {
    dev::arrive_expecting(to.full(), T::kStage);
    if constexpr (T::kGated)
      dev::copy_box(to.operands(), job.gate_weight, step * kHopperDepth, place.column0, to.full());
    dev::copy_box(to.operands() + (T::kColumns - T::kColumnsY) * kSwizzledRow, job.weight, step * kHopperDepth,
                  place.column0, to.full());
  }
  /// Fetches this block's part of the rows for all blocks.
  VLA_DEVICE void rows(const Stages<T>& to, int step) const {
    constexpr unsigned kAllBlocks = (1U << kTmaCluster) - 1;
    const int row = place.rank * T::kRowsOfBlock;
    dev::copy_box_to_blocks(to.operands() + T::kBytesW + row * kSwizzledRow, job.x, step * kHopperDepth,
                            place.row0 + row, to.full(), kAllBlocks);
  }
};

/// What the last warp does: its first lane fetches all steps, the first weights before earlier kernels have ended.
/// Returns the stages in that lane's turn.
template <class T>
VLA_DEVICE Stages<T> fetch_all(const Fetch<T>& fetch, std::byte* shared, int n_step) {
  const bool is_first = thread_index() == T::kMultipliers;
  const int n_ahead = n_step < T::kStages ? n_step : T::kStages;
  Stages<T> stages = {shared};
  for (int i = 0; is_first && i < n_ahead; ++i, stages.go_on()) fetch.weights(stages, i);
  dev::wait_for_earlier();
  stages = {shared};
  for (int i = 0; is_first && i < n_ahead; ++i, stages.go_on()) fetch.rows(stages, i);
  stages = {shared};
  for (int i = n_ahead; is_first && i < n_step; ++i, stages.go_on()) {
    dev::wait_mbarrier(stages.empty(), stages.parity);
    fetch.weights(stages, i);
    fetch.rows(stages, i);
  }
  __syncwarp();
  return stages;
}

/// Waits until all warps of the cluster have read what was fetched last: then none arrives here any more, and the block
/// may end.
template <class T>
VLA_DEVICE void wait_for_readers(Stages<T> stages, int n_step) {
  for (int i = 0; i < n_step && i < T::kStages; ++i, stages.go_on()) dev::wait_mbarrier(stages.empty(), stages.parity);
}

/// What the other warps do. A stage is free once the products after those that read it have been issued.
template <class T>
VLA_DEVICE void multiply_all(float (&sum)[T::kRows / 2], std::byte* shared, int n_step) {
  const auto leave = [](const Stages<T>& stages) {  // in all blocks, an arrival of a lane each
    const int lane = thread_index() % kLanes;
    if (lane < kTmaCluster) dev::arrive_at_block(stages.empty(), lane);
  };
  const std::uint64_t of_stage = T::kStage / 16;
  const std::uint64_t w0 = swizzled_descriptor(shared + thread_index() / 128 * 64 * kSwizzledRow);
  const std::uint64_t x0 = swizzled_descriptor(shared + T::kBytesW);
  Stages<T> stages = {shared}, before = {shared};
  int i = 0;
  do {
    dev::wait_mbarrier(stages.full(), stages.parity);
    const std::uint64_t w = w0 + stages.stage * of_stage, x = x0 + stages.stage * of_stage;
    dev::wgmma_fence();
#pragma unroll
    for (int k = 0; k < 4; ++k) dev::wgmma_bf16<T::kRows>(sum, w + 2 * k, x + 2 * k, i + k > 0);
    dev::wgmma_commit();
    dev::wgmma_wait<1>();
    if (i > 0) leave(before);
    before = stages;
    stages.go_on();
  } while (++i < n_step);
  dev::let_next_begin();
  dev::wgmma_wait_all(sum);
  leave(before);
}

template <class T>
VLA_DEVICE void multiply(const HopperTmaJob& job) {
  std::byte* shared = dev::shared_memory();
  const Place<T> place;
  const int n_step = (job.product.depth + kHopperDepth - 1) / kHopperDepth;
  if (thread_index() == 0) Stages<T>{shared}.begin();
  dev::meet_cluster();  // mbarriers of all blocks have begun
  using End = TileEnd<float, T::kColumns, T::kRows, T::kGated>;
  if (thread_index() >= T::kMultipliers) {
    const Stages<T> stages = fetch_all<T>({job, place}, shared, n_step);
    __syncthreads();
    End::attend();
    if (thread_index() == T::kMultipliers) wait_for_readers(stages, n_step);
    return;
  }
  float sum[T::kRows / 2] = {};
  dev::wait_for_earlier();
  const RowTerms terms =
      thread_index() < T::kRows ? terms_of_row(job.product, place.row0 + thread_index()) : RowTerms();
  multiply_all<T>(sum, shared, n_step);
  __syncthreads();  // the stages' memory is reused for sums
  End::place(sum, shared);
  std::byte* const all_terms = shared + T::kRows * (T::kColumns + 4) * 4;
  static_assert(T::kRows * (T::kColumns + 6) * 4 <= T::kStages * T::kStage);
  if (thread_index() < T::kRows) dev::write(all_terms + thread_index() * sizeof(RowTerms), terms);
  const End end(job.product, job.product.gate_bias, job.product.n_row, place.row0, place.column0);
  end.finish(
      shared, [&](int row) { return dev::read<RowTerms>(all_terms + (row - place.row0) * sizeof(RowTerms)); },
      EndsNorm < T::kGated ? 2 : 1 > {job.product});
}

}  // namespace

#define VLA_HOPPER_KERNEL(columns, rows)                                                                \
  VLA_EARLY_KERNEL(hopper_tma_bf16_##columns##x##rows, columns * 2 + kLanes, 1, HopperTmaJob) {         \
    multiply<Tile<columns, rows, false>>(job);                                                          \
  }                                                                                                     \
  VLA_EARLY_KERNEL(hopper_tma_bf16_##columns##x##rows##_gated, columns * 2 + kLanes, 1, HopperTmaJob) { \
    multiply<Tile<columns, rows, true>>(job);                                                           \
  }
VLA_HOPPER_TMA_TILES(VLA_HOPPER_KERNEL)
#undef VLA_HOPPER_KERNEL

}  // namespace vla::cuda

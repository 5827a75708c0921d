// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "cuda/kernels/tensor_map.h"

namespace vla::test::cuda {

enum class Mistake {
  none,
  no_barrier,
  no_warp_barrier,
  write_after_read,
  no_wait,
  wait_without_barrier,
  behind_shared,
  not_aligned,
  some_lanes_shuffle,
  some_warps_wait,
  different_instructions,
  // In clusters of two blocks.
  no_mistake_of_cluster,
  no_cluster_barrier,
  barrier_of_block,
  barrier_releases_nothing,
  write_after_barrier,
  write_of_what_is_read,
  read_of_ended_block,
  some_threads_leave,
  no_such_block,
  // With mbarriers, in clusters of two blocks.
  no_mistake_with_mbarriers,
  no_fence_of_mbarriers,
  no_barrier_after_begin,
  no_wait_for_copies,
  wait_for_other_parity,
  nothing_expected,
  too_few_bytes,
  too_many_bytes,
  copy_to_one_block,
  no_wait_for_readers,
  arrival_before_read,
  arrival_without_warp_barrier,
  arrival_at_one_block,
  arrival_too_often,
  end_without_others,
  nobody_waits,
};

}  // namespace vla::test::cuda

namespace vla::cuda {

struct MisbehaveJob {
  test::cuda::Mistake mistake;
  const int* x;  // [4]
  int* y;        // [64] for each block
};

/// Rounds of copies of two boxes of eight rows, one by each block of a cluster, to both.
struct MisbehaveCopyJob {
  static constexpr int kRounds = 3, kBoxRows = 8;
  TensorMap x;  // [64, 2 * kBoxRows * kRounds]
  test::cuda::Mistake mistake;
  unsigned* y;  // [32] for each block
};

}  // namespace vla::cuda

// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

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
};

}  // namespace vla::test::cuda

namespace vla::cuda {

struct MisbehaveJob {
  test::cuda::Mistake mistake;
  const int* x;  // [4]
  int* y;        // [64] for each block
};

}  // namespace vla::cuda

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
};

}  // namespace vla::test::cuda

namespace vla::cuda {

struct MisbehaveJob {
  test::cuda::Mistake mistake;
  const int* x;  // [4]
  int* y;        // [64] for each block
};

}  // namespace vla::cuda

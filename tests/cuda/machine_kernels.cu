// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Kernels that do what none may, for machine_test.cpp.
#include "cuda/kernels/hopper.h"
#include "cuda/machine_kernels.h"

namespace vla::cuda {

/// Each block writes its threads' numbers and reads the other one's.
VLA_DEVICE int misbehave_in_cluster(test::cuda::Mistake mistake) {
  using test::cuda::Mistake;
  std::byte* own = dev::shared_memory() + thread_index() * 16;
  const int rank = static_cast<int>(blockIdx.z), other = mistake == Mistake::no_such_block ? 2 : 1 - rank;
  const auto write = [&](int number) { dev::write(own, uint4{static_cast<unsigned>(number), 0, 0, 0}); };
  if (mistake != Mistake::write_after_barrier) write(rank * 100 + thread_index());
  if (mistake == Mistake::barrier_of_block)
    __syncthreads();
  else if (mistake == Mistake::barrier_releases_nothing)
    dev::leave_cluster();
  else if (mistake != Mistake::no_cluster_barrier)
    dev::meet_cluster();
  if (mistake == Mistake::write_after_barrier) write(0);
  const auto read = static_cast<int>(dev::read_of_block(own, other).x);
  if (mistake == Mistake::write_of_what_is_read) write(0);
  if (mistake == Mistake::some_threads_leave && thread_index() == 5) return read;
  if (mistake != Mistake::read_of_ended_block) dev::leave_cluster();
  return read;
}

VLA_KERNEL(misbehave, 64, 1, MisbehaveJob) {
  using test::cuda::Mistake;
  std::byte* shared = dev::shared_memory();
  const int thread = thread_index(), lane = thread % kLanes;
  int sum = 0;
  switch (job.mistake) {
    case Mistake::none:
      dev::write(shared + thread * 4, thread);
      __syncthreads();
      sum = dev::read<int>(shared + (63 - thread) * 4);
      break;
    case Mistake::no_barrier:
      dev::write(shared + thread * 4, thread);
      sum = dev::read<int>(shared + (63 - thread) * 4);
      break;
    case Mistake::no_warp_barrier:
      dev::write(shared + thread * 4, thread);
      sum = dev::read<int>(shared + (thread ^ 1) * 4);
      break;
    case Mistake::write_after_read:
      sum = dev::read<int>(shared);
      dev::write(shared, thread);
      break;
    case Mistake::no_wait:
      dev::copy_async(shared + thread * 16, job.x, 16);
      dev::commit_copies();
      sum = dev::read<int>(shared + thread * 16);
      break;
    case Mistake::wait_without_barrier:
      dev::copy_async(shared + thread * 16, job.x, 16);
      dev::commit_copies();
      dev::wait_copies<0>();
      sum = dev::read<int>(shared + (thread ^ 32) * 16);
      break;
    case Mistake::behind_shared:
      sum = dev::read<int>(shared + 1024);
      break;
    case Mistake::not_aligned:
      sum = static_cast<int>(dev::read<float2>(shared + 4).x);
      break;
    case Mistake::some_lanes_shuffle:
      if (lane < 16) sum = dev::shuffle_xor(sum, 1);
      break;
    case Mistake::some_warps_wait:
      if (thread >= kLanes) __syncthreads();
      break;
    case Mistake::different_instructions:
      sum = lane < 16 ? dev::shuffle_xor(thread, 1) : sum;
      if (lane >= 16) __syncwarp();
      break;
    default:
      sum = misbehave_in_cluster(job.mistake);
  }
  job.y[static_cast<int>(blockIdx.x + blockIdx.z) * 64 + thread] = sum;
}

/// Reads the copies' first words of 32 half rows in each round, and adds them up.
VLA_DEVICE unsigned read_rounds(const MisbehaveCopyJob& job, std::byte* full, std::byte* empty) {
  using test::cuda::Mistake;
  const int lane = thread_index() % kLanes;
  unsigned sum = 0;
  const auto arrive = [&] {
    if (lane == 0 || (lane == 1 && job.mistake != Mistake::arrival_at_one_block)) dev::arrive_at_block(empty, lane);
  };
  for (int i = 0; i < job.kRounds; ++i) {
    const unsigned parity = job.mistake == Mistake::wait_for_other_parity ? i % 2 == 0 : i % 2;
    if (job.mistake != Mistake::no_wait_for_copies) dev::wait_mbarrier(full, parity);
    if (job.mistake == Mistake::arrival_before_read) arrive();
    sum += dev::read<unsigned>(dev::shared_memory() + lane * 64);
    if (job.mistake != Mistake::arrival_without_warp_barrier) __syncwarp();
    if (job.mistake != Mistake::arrival_before_read) arrive();
    if (job.mistake == Mistake::arrival_too_often) arrive();
  }
  return sum;
}

VLA_KERNEL(misbehave_with_copies, 64, 1, MisbehaveCopyJob) {
  using test::cuda::Mistake;
  constexpr int kBox = 1024;
  std::byte *shared = dev::shared_memory(), *full = shared + 2 * kBox, *empty = full + 8;
  const int thread = thread_index(), rank = static_cast<int>(blockIdx.z);
  if (thread == 0) {
    dev::begin_mbarrier(full, 1), dev::begin_mbarrier(empty, 2);
    if (job.mistake != Mistake::no_fence_of_mbarriers) dev::fence_mbarriers();
  }
  if (job.mistake != Mistake::no_barrier_after_begin) dev::meet_cluster();
  if (thread < kLanes && job.mistake != Mistake::nobody_waits)
    job.y[rank * kLanes + thread] = read_rounds(job, full, empty);
  const int n_round = job.mistake == Mistake::nobody_waits ? 1 : job.kRounds;
  for (int i = 0; thread == kLanes && i < n_round; ++i) {
    if (job.mistake != Mistake::no_wait_for_readers) dev::wait_mbarrier(empty, i % 2 == 0);
    if (job.mistake == Mistake::nothing_expected)
      dev::arrive(full);
    else
      dev::arrive_expecting(full, 2 * kBox + (job.mistake == Mistake::too_few_bytes    ? -16
                                              : job.mistake == Mistake::too_many_bytes ? 16
                                                                                       : 0));
    dev::copy_box_to_blocks(shared + rank * kBox, job.x, 0, (2 * i + rank) * job.kBoxRows, full,
                            job.mistake == Mistake::copy_to_one_block ? 1U << rank : 3);
  }
  if (job.mistake != Mistake::end_without_others) dev::leave_cluster();
}

}  // namespace vla::cuda

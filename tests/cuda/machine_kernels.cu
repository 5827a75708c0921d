// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Kernels that do what none may, for machine_test.cpp.
#include "cuda/kernels/device.h"
#include "cuda/machine_kernels.h"

namespace vla::cuda {

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
  }
  job.y[static_cast<int>(blockIdx.x) * 64 + thread] = sum;
}

}  // namespace vla::cuda

// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>

namespace vla::cuda {

struct Grid {
  unsigned x = 1, y = 1, z = 1;
};

/// A kernel's name and launch configuration. A kernel's only parameter is the job that its header defines.
struct Launch {
  const char* kernel;
  Grid grid;
  unsigned n_thread;
  unsigned shared = 0;   // bytes of dynamic shared memory
  unsigned cluster = 1;  // blocks that follow each other in z and form a cluster; more than one only on Hopper
};

/// Marks functions that kernels and host code share.
#ifdef __CUDACC__
#define VLA_HOST_DEVICE __host__ __device__
#else
#define VLA_HOST_DEVICE
#endif

/// Largest shared memory of a block on the devices with least: sm_86, sm_89 and sm_120.
constexpr unsigned kMaxShared = 99 << 10;
/// The same on Hopper.
constexpr unsigned kHopperShared = 227 << 10;
/// Most blocks of a cluster on every Hopper.
constexpr unsigned kMaxCluster = 8;
/// How a product in Hopper's tiles may split its depth: the number of shares, and whether a cluster adds them.
struct HopperSplit {
  int n_split;
  bool in_cluster;
};
constexpr HopperSplit kHopperSplits[] = {{1, false}, {2, false}, {2, true}, {3, false}, {3, true}, {4, false},
                                         {4, true},  {6, false}, {6, true}, {8, false}, {8, true}};
/// The cluster of a product in Hopper's tiles or of attention: its shares of the depth or of the keys, unless they go
/// to partial sums.
template <class Job>
unsigned cluster_of(const Job& job) {
  return job.partial != nullptr ? 1 : static_cast<unsigned>(job.n_split);
}
/// Most blocks of a grid in y and z.
constexpr unsigned kMaxGridYZ = 65535;

/// The most jobs of one kernel in one launch. The jobs' blocks follow each other in x, for Hopper's tiles in y:
/// `end` of a job is the first block of the next.
constexpr int kMostJobs = 3;
template <class Job, int kMost = kMostJobs>
struct Several {
  Job job[kMost];
  unsigned end[kMost];
  int n;
};

/// Sets `end` of each job, which has n_block(job) blocks. Returns the number of all blocks.
template <class Job, int kMost, class Count>
unsigned fill_ends(Several<Job, kMost>& jobs, Count n_block) {
  unsigned end = 0;
  for (int i = 0; i < jobs.n; ++i) jobs.end[i] = end += n_block(jobs.job[i]);
  return end;
}

constexpr unsigned blocks(std::int64_t n, std::int64_t size) { return static_cast<unsigned>((n + size - 1) / size); }
constexpr std::int64_t round_up(std::int64_t n, std::int64_t unit) { return (n + unit - 1) / unit * unit; }

}  // namespace vla::cuda

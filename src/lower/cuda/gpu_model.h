// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>

#include "lower/cuda/cuda_lowering.h"

namespace vla::lower {

/// A GPU's published figures, without sparsity and at the clock that the maker's peaks are told for: the basis of
/// predictions for GPUs that are not there.
struct GpuModel {
  const char *name, *description;
  int n_sm;
  bool is_hopper = false;  // has its own kernels
  double clock;            // Hz
  double bf16, int8;  // operations a second of tensor units by our instructions (mma.sync), sums in float32 and int32
  double f32, dot4;   // of fused multiply-adds of floats, and of four bytes at a time
  double bandwidth;   // bytes a second
  int shared;         // bytes of shared memory of an SM
  double launch;      // seconds between a kernel of a graph and one that waits for it
};

/// Errors: usage.
Result<GpuModel> find_gpu_model(const std::string& name);

/// How long the phases of a program take on it: products and attention in whole waves of blocks, by the issue slots or
/// the tensor time of their main loops, or all operands once over the memory, whichever takes longer; then launches,
/// and what the smallest kernel takes. Entries as Program::predictions has them. n_launch: of the kernels that each
/// operation is.
std::vector<Program::Prediction> predict(const CudaLowering& l, const std::vector<int>& n_launch, const GpuModel& gpu);

}  // namespace vla::lower
